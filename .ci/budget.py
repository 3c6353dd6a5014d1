"""The budget of the packages: lines, modules, length of functions, direction of imports."""

from __future__ import annotations

import ast
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Packages in the order of their layers: each imports those before it only.
PACKAGES = ("simulator", "ae_env", "agents")
#: A function is counted without its docstring.
MAX_LINES, MAX_MODULES, MAX_FUNCTION, MAX_FOLDER = 42_677, 145, 60, 15
#: Kernels whose inner calls would cost time (a tenth of a recorded frame), and their lines.
LONGER = {"simulator.capture.sensor.record_units": 69}
MAX_LINES_OF = {"benchmarks": 7_200, "tests": 20_657}


def module_name(path: Path) -> str:
    """Dotted name of a file of the packages."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST, modules: dict[str, Path]) -> set[str]:
    """Modules of the packages that a module imports anywhere, but for types alone."""
    found, pending = set[str](), [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {name if name in modules else node.module for name in names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        pending += ast.iter_child_nodes(node)
    return found & modules.keys()


def lines_of(folder: str) -> int:
    """Lines of the Python files below a folder."""
    return sum(
        len(p.read_text(encoding="utf-8").splitlines()) for p in (ROOT / folder).rglob("*.py")
    )


def main() -> None:
    """Prints the figures, then what is over the budget; exits with 1 if anything is."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    modules = {module_name(path): path for path in paths}
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in modules.items()}
    faults, graph = list[str](), dict[str, set[str]]()
    for name, tree in trees.items():
        graph[name] = imported(tree, modules) - {name}
        layer = PACKAGES.index(name.split(".")[0])
        upward = [other for other in graph[name] if PACKAGES.index(other.split(".")[0]) > layer]
        faults += [f"{name} imports {other}, of a layer above" for other in sorted(upward)]
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                length -= len((ast.get_docstring(node, clean=False) or "").splitlines())
                most = LONGER.get(f"{name}.{node.name}", MAX_FUNCTION)
                if length > most:
                    faults.append(f"{name}.{node.name} has {length} lines: at most {most}")
    # Packages that load their public names lazily import nothing by themselves.
    packages = {name for name, path in modules.items() if path.name == "__init__.py"}
    edges = {name: graph[name] - packages for name in graph.keys() - packages}
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        faults.append(f"a circle of imports: {' -> '.join(error.args[1])}")
    for folder in sorted({path.parent for path in paths}):
        count = sum(path.parent == folder and path.name != "__init__.py" for path in paths)
        if count > MAX_FOLDER:
            faults.append(f"{folder.relative_to(ROOT)} has {count} modules: at most {MAX_FOLDER}")
    lines, count = sum(map(lines_of, PACKAGES)), len(modules.keys() - packages)
    figures = [("lines of packages", lines, MAX_LINES), ("modules", count, MAX_MODULES)]
    figures += [(f"lines of {name}", lines_of(name), most) for name, most in MAX_LINES_OF.items()]
    for name, figure, most in figures:
        print(f"{name}: {figure} of {most}")
        if figure > most:
            faults.append(f"{name}: {figure - most} above the budget")
    print(*faults, sep="\n")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
