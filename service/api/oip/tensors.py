"""What the protocol's transports have in common: a request they have read, and an answer that they are to write."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from service.api.oip.schema import AnswerParameters, InferRequest
from service.api.route import Reply


class Header(NamedTuple):
    """Who answered."""

    model: str
    version: str
    parameters: AnswerParameters


class Answer(NamedTuple):
    """An answered tensor; binary: whether its request asks for bytes rather than a list."""

    name: str
    values: NDArray[np.float64]
    binary: bool


class Message(Protocol):
    """A request of one transport. The numbers of its tensors are still as they came."""

    @property
    def request(self) -> InferRequest:
        """All but the numbers."""

    def check(self) -> None:
        """Look whether the numbers lie where the request says; raise InvalidRequestError."""

    def numbers(self, place: int, dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
        """Numbers of the input at this place, flat or in rows: as many as its shape has, whose elements are `dtype`;
        raise InvalidRequestError. To be asked in the order of the inputs."""

    def encode(self, header: Header, answers: list[Answer]) -> Reply:
        """The answer as this transport has it."""
