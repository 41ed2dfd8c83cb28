"""What learning refuses beyond the errors that every route knows."""

from __future__ import annotations

from service.foundation.errors import ServiceError


class LearningDisabledError(ServiceError):
    """The model's owner has switched its learning off."""

    status, code = 409, "learning_disabled"


class ExpiredError(ServiceError):
    """The batch is so old that it is not known any more whether it has been learnt."""

    status, code = 409, "expired"
