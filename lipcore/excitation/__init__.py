"""Plan motions that reduce the uncertainty of a model most."""

from lipcore.excitation.information import Belief
from lipcore.excitation.limits import Limits
from lipcore.excitation.motions import Series
from lipcore.excitation.planning import Plan, PlanOptions, plan

__all__ = ["Belief", "Limits", "Plan", "PlanOptions", "Series", "plan"]
