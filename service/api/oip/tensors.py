"""Interface of the transports: a request that a transport has decoded, and an answer that it encodes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from service.api.oip.schema import AnswerParameters, InferRequest
from service.api.route import Reply


class Header(NamedTuple):
    """Model and version that answered."""

    model: str
    version: str
    parameters: AnswerParameters


class Answer(NamedTuple):
    """An output tensor; `binary`: whether the request asks for bytes instead of a list."""

    name: str
    values: NDArray[np.float64]
    binary: bool


class Message(Protocol):
    """A request of one transport. The numbers of its tensors are not decoded yet."""

    @property
    def request(self) -> InferRequest:
        """The request without the numbers."""

    def is_binary(self, outputs: Iterable[bool]) -> bool:
        """Return whether all tensors are bytes, those of the answer too. outputs: whether each is requested so."""

    def check(self) -> None:
        """Check that the numbers are where the request says; raise InvalidRequestError."""

    def numbers(self, place: int, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
        """Return the numbers of the input at this index, flat or in rows; raise InvalidRequestError.

        There are as many as the input's shape needs, with elements of type `dtype`. Call it in the order of the inputs.
        """

    def encode(self, header: Header, answers: list[Answer]) -> Reply:
        """Encode the answer for this transport."""
