"""README, docs and site: links lead somewhere, code runs as printed, commands parse, it builds."""

import contextlib
import io
import json
import os
import pkgutil
import re
import shlex
import sys
import tomllib
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import typer
import yaml

from ae_env.scorers import make_scorer
from agents.cli.main import app
from agents.learning.training import AgentConfig
from agents.metering import metering_policy
from simulator import CameraSettings, NoiseLevelFunction, RawImage, get_camera, write_dng
from simulator.camera import BayerPattern, CameraProfile

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += [ROOT / "docs" / "results" / "README.md"]
SCORER_PAGE = ROOT / "docs" / "plug-in-a-scorer.md"
#: Pages that are scripts.
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
FEW = "bundled:photograph"
SMALL = {"scenes": FEW, "resolution": 36}


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a language, but for those marked `<!-- not run: reason -->`."""
    pattern = rf"^(<!-- not run: [^\n]+ -->\n)?```{language}\n(.*?)^```$"
    found = re.findall(pattern, page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [code for mark, code in found if not mark]


def _anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, made as GitHub makes them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_files_and_modules_are_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    for link in (link for link in links if "://" not in link):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{link} in {_name(page)}"
        if anchor:
            assert anchor in _anchors(target), f"{link} in {_name(page)}"
    for path in re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|yaml))`", text):
        assert (ROOT / path).is_file(), path
    for name in re.findall(r"`((?:simulator|ae_env|agents)(?:\.\w+)+)`", text):
        pkgutil.resolve_name(name)


def test_printed_examples_are_those_in_the_folder() -> None:
    names = []
    for block in (block for page in PAGES for block in _blocks(page, "python")):
        if name := re.match(r"# examples/(\w+\.py)\n", block):
            file = (ROOT / "examples" / name[1]).read_text(encoding="utf-8")
            _, _, code = file.partition('"""\n')  # the page explains what the docstring says
            assert block.removeprefix(name[0]) == code.lstrip("\n"), name[1]
            names.append(name[1])
    assert {"train_ppo.py", "my_policy.py"} <= set(names)


def _write_files(folder: Path) -> None:
    """Writes the files that pages read: raws, and samples of an industrial camera."""
    nlf = {100: NoiseLevelFunction(shot=(2e-4,) * 4, read=(1e-6,) * 4)}
    levels = {"black_level": (256,) * 4, "white_level": 4095, "bit_depth": 12}
    bench = CameraProfile(name="bench", cfa=BayerPattern.GBRG, nlf_by_iso=nlf, **levels)
    light = torch.rand(4, 64, 96, generator=torch.Generator().manual_seed(0)) * 0.5
    settings = CameraSettings(100, 1 / 64, 4.0)
    write_dng(folder / "frame.dng", RawImage(light, settings, bench))
    write_dng(folder / "IMG_0001.dng", RawImage(light, settings, get_camera("nikon_z6")))
    for suffix in (".CRW", ".CR2"):  # a raw is known by its content
        (folder / f"IMG_0001{suffix}").write_bytes((folder / "IMG_0001.dng").read_bytes())
    samples = np.random.default_rng(0).integers(256, 4096, (512, 768), dtype=np.uint16)
    samples.tofile(folder / "frame_768x512_rggb.raw")


def _run(code: str, folder: Path) -> None:
    """Runs a page where nobody has imported `ae_env`, with few scenes and small frames."""
    # The agents of the package look at 64 x 64 pixels.
    small = SMALL if "regression" not in code else {"scenes": SMALL["scenes"]}
    _write_files(folder)

    def with_few(make):
        return lambda name, **arguments: make(name, **{**arguments, **small})

    os.chdir(folder)
    torch.set_num_threads(1)
    metering_policy.FIT_PER_SCENE = 1
    del sys.modules["ae_env"]
    for name in [name for name in gym.registry if name.startswith("ae_env/")]:
        del gym.registry[name]
    gym.make, gym.make_vec = with_few(gym.make), with_few(gym.make_vec)
    exec(compile(code, "page.py", "exec"), {"__name__": "__main__"})


WITH_CODE = [page for page in PAGES if page != SCORER_PAGE and _blocks(page, "python")]
_FIRST, *_OTHERS = (*WITH_CODE, *TUTORIALS)


@pytest.mark.parametrize("page", [_FIRST, *(pytest.param(page) for page in _OTHERS)], ids=_name)
def test_code_runs_as_printed(page, tmp_path, forkserver):
    code = page.read_text() if page.suffix == ".py" else "\n".join(_blocks(page, "python"))
    for printed, short in (
        (r"STEPS = [\d_]+", "STEPS = 64"),
        (r"n_steps=256\)\.learn\([\d_]+\)", "n_steps=64).learn(64)"),
        (r"num_envs=64", "num_envs=4"),
        (r"episodes=32|reset\(32\)", lambda found: found[0].replace("32", "4")),
        (r'"bundled"', f'"{FEW}"'),
        (r"EPISODES = \d+", "EPISODES = 4"),
        (r'"resolution": 64', '"resolution": 36'),
    ):
        code = re.sub(printed, short, code)
    with ProcessPoolExecutor(1, mp_context=forkserver) as pool:
        pool.submit(_run, code, tmp_path).result()


def _printed(code: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(code, {})
    return printed.getvalue()


def test_the_notebook_prints_what_it_shows(forkserver) -> None:
    cells = json.loads((ROOT / "examples" / "first_look.ipynb").read_text())["cells"]
    code = "\n".join("".join(c["source"]) for c in cells if "outputs" in c)
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    with ProcessPoolExecutor(1, mp_context=forkserver) as pool:
        printed = pool.submit(_printed, code.partition("\n")[2]).result()
    assert printed == "".join(line for output in outputs for line in output.get("text", []))


def _commands(page, pattern):
    """The words after `ae-env` of every command that the pattern finds, without comments."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for line in re.findall(pattern, text, re.MULTILINE):
        yield shlex.split(line, comments=True)


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_commands_parse(page: Path) -> None:
    group = typer.main.get_command(app)
    with group.make_context("ae-env", ["scorers"]) as context:
        for words in _commands(page, r"^ *ae-env (.+)$"):
            name, command, rest = group.resolve_command(context, words)
            command.make_context(name, rest, parent=context)
        for words in _commands(page, r"`ae-env ([^`\n]+)`"):  # may lack arguments
            _, command, rest = group.resolve_command(context, words)
            known = {option for parameter in command.params for option in parameter.opts}
            assert {word for word in rest if word.startswith("-")} <= {*known, "--help"}


def test_the_scorer_computes_what_it_says_and_is_used_as_printed(ae_env, tmp_path, capsys):
    """In Python, in a configuration, on the command line and in a package."""
    (tmp_path / "my_scorer.py").write_text(_blocks(SCORER_PAGE, "python")[0])
    pictures = torch.zeros(2, 3, 40, 40)
    pictures[0, :, 10:30, 10:20] = 0.8  # half of the middle: standard deviation 0.4
    pictures[1, :, :10] = 1.0  # outside of the middle
    scorer = make_scorer("my_scorer.py:CentreContrast").parts["CentreContrast"]
    scores = scorer(pictures, None)
    torch.testing.assert_close(scores, torch.tensor([0.8, 0.0]), atol=1e-3, rtol=0.0)
    use = _blocks(SCORER_PAGE, "python")[1]
    assert "resolution=64" in use
    exec(use.replace("resolution=64", 'resolution=36, scenes="bundled:snow"'), {})
    assert re.search("CentreContrast.*noise", capsys.readouterr().out, re.DOTALL)
    (text,) = _blocks(SCORER_PAGE, "yaml")
    config = AgentConfig.model_validate(yaml.safe_load(text))
    assert config.environment["scorer"] == {"my_scorer.py:CentreContrast": 0.5, "noise": 0.5}
    with pytest.raises(ValueError, match=r"your_scorer\.py"):
        AgentConfig.model_validate(yaml.safe_load(text.replace("my_", "your_")))
    (words,) = _commands(SCORER_PAGE, r"`ae-env (evaluate [^`]+)`")
    assert words[-2:] == ["--scorer", "my_scorer.py:CentreContrast"]
    small = "--scenes bundled:snow --resolution 36 --frames 2 --episodes 1 --workers 1 --out out"
    code, _, err = ae_env(*words, *small.split())
    assert code == 0, err
    assert (tmp_path / "out" / "results.json").is_file()
    project = tomllib.loads(_blocks(SCORER_PAGE, "toml")[0])
    (module,) = project["tool"]["setuptools"]["py-modules"]
    assert project["project"]["entry-points"] == {
        "ae_env.scorers": {"centre_contrast": f"{module}:CentreContrast"}
    }
    assert (tmp_path / f"{module}.py").is_file()


#: Pages of the site that are written out.
WRITTEN = {"index", "tasks", "viewer", "api/simulator.CameraSettings", "tutorials/explore_a_raw"}


def _build(folder: Path) -> tuple[str, set[str]]:
    """Reads all pages, writes some; returns the warnings, and images of the others."""
    import docutils.nodes
    from sphinx.application import Sphinx

    # But for `viewcode`: 40 pages of the packages' own text, of which nothing is tested here.
    parts = [f"sphinx.ext.{name}" for name in ("autodoc", "autosummary", "napoleon")]
    used = {"extensions": ["myst_parser", *parts]}
    warnings, folders = io.StringIO(), (ROOT / "docs", ROOT / "docs", folder, folder / "doctrees")
    more = {"confoverrides": {**used, "smartquotes": False}, "status": None}
    site = Sphinx(*folders, "html", **more, warning=warnings)
    builder = site.builder
    builder.search = False  # which wants to see all pages
    site.build(filenames=[site.env.doc2path(name) for name in WRITTEN])
    images = set[str]()
    for name in sorted(site.env.found_docs - WRITTEN):  # where do their links lead?
        page = site.env.get_and_resolve_doctree(name, builder)
        images |= {image["uri"] for image in page.findall(docutils.nodes.image)}
    return warnings.getvalue(), images


def test_the_site(tmp_path, forkserver):
    with ProcessPoolExecutor(1, mp_context=forkserver) as pool:
        warnings, images = pool.submit(_build, tmp_path).result()
    assert warnings == ""
    assert [image for image in images if "//" in image] == [] != images
    for name in WRITTEN:
        text = (tmp_path / f"{name}.html").read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe|source|link) [^>]*(?:src|href)="([^"]+)"', text)
        assert loaded
        assert [address for address in loaded if "//" in address] == [], name
    # The tasks are the docstrings of their classes.
    text = (tmp_path / "tasks.html").read_text(encoding="utf-8")
    for title in ("AutoExposure-v0", "AutoExposureVideo-v0", "ExposureBracket-v0"):
        assert f"<h2>{title}" in text
    assert text.count("<h3>Action Space") == 3
    assert "{docstring}" not in text
    text = (tmp_path / "api" / "simulator.CameraSettings.html").read_text("utf-8")
    assert 'id="simulator.CameraSettings.f_number"' in text
    # Tutorials are pages of text and code.
    text = (tmp_path / "tutorials" / "explore_a_raw.html").read_text(encoding="utf-8")
    assert ("<h1>Explore a raw" in text, "# %%" in text) == (True, False)
    assert 'class="highlight-python' in text
