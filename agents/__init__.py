"""Exposure policies, from a spot meter to PPO, and the evaluation that compares them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_NAMES_BY_MODULE = {
    "evaluation.engine": "evaluate fit_policies",
    "evaluation.evaluation_plan": "EvaluationPlan load_plan",
    "evaluation.jobs": "run_plan",
    "evaluation.result": "EvaluationResult result_rows",
    "metering.metering_policy": "MeteringPolicy",
    "policy": "Policy PolicyContext",
    "policy_names": "list_policies make_policy",
    "report.evaluation": "write_report",
}
_EXPORTS = {name: module for module, names in _NAMES_BY_MODULE.items() for name in names.split()}
__all__ = sorted(_EXPORTS)

if TYPE_CHECKING:
    from agents.evaluation.engine import evaluate as evaluate
    from agents.evaluation.engine import fit_policies as fit_policies
    from agents.evaluation.evaluation_plan import EvaluationPlan as EvaluationPlan
    from agents.evaluation.evaluation_plan import load_plan as load_plan
    from agents.evaluation.jobs import run_plan as run_plan
    from agents.evaluation.result import EvaluationResult as EvaluationResult
    from agents.evaluation.result import result_rows as result_rows
    from agents.metering.metering_policy import MeteringPolicy as MeteringPolicy
    from agents.policy import Policy as Policy
    from agents.policy import PolicyContext as PolicyContext
    from agents.policy_names import list_policies as list_policies
    from agents.policy_names import make_policy as make_policy
    from agents.report.evaluation import write_report as write_report


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(f"agents.{_EXPORTS[name]}"), name)
    raise AttributeError(f"module 'agents' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
