"""Exposure policies, from a spot meter to PPO, and the evaluation that compares them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_EXPORTS = {
    "EvaluationPlan": "evaluation.evaluation_plan",
    "EvaluationResult": "evaluation.result",
    "MeteringPolicy": "metering.metering_policy",
    "Policy": "policy",
    "PolicyContext": "policy",
    "evaluate": "evaluation.engine",
    "fit_policies": "evaluation.engine",
    "list_policies": "policy_names",
    "load_plan": "evaluation.evaluation_plan",
    "make_policy": "policy_names",
    "result_rows": "evaluation.result",
    "run_plan": "evaluation.jobs",
    "write_report": "report.evaluation",
}
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
