"""The compilers of the C++ client."""

from tests.clients.cpp.conftest import any_compiler

__all__ = ["any_compiler"]
