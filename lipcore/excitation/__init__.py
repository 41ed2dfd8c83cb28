"""Planning motions that tell a model what it does not know yet."""

from lipcore.excitation.belief import Belief
from lipcore.excitation.limits import Limits
from lipcore.excitation.planning import Plan, PlanOptions, plan
from lipcore.excitation.series import Series

__all__ = ["Belief", "Limits", "Plan", "PlanOptions", "Series", "plan"]
