"""Compiled code that was kept, loaded without its bitcode, which nothing needs but a kernel that takes it in."""

# mypy: disable-error-code="no-untyped-call, misc"
# numba has no types

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped]  # it has no types
from numba.core import codegen as numba_codegen

NumbasLibrary: Any = numba_codegen.JITCodeLibrary
"""Numba's own: machine code and bitcode of one function, of which it parses the bitcode when it loads both."""


class KernelLibrary(NumbasLibrary):
    """The same, with the bitcode parsed when it is asked for: of thirty kernels that takes a twentieth of a search."""

    _unread = b""

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, Any]) -> Any:
        name, kind, data = state
        if kind != "object":
            return super()._unserialize(codegen, state)
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(data[0])
        library._finalize_final_module()
        library._unread = data[1]
        return library

    def _get_module_for_linking(self) -> Any:
        if self._unread:
            self._shared_module, self._unread = llvm.parse_bitcode(self._unread), b""
            self._codegen._engine._load_defined_symbols(self._shared_module)
        return super()._get_module_for_linking()

    def get_pointer_to_function(self, name: str) -> int:
        """Address of a function: while the bitcode is unread, of one that was kept with it.

        Numba asks for those that it has kept the names of; which there are besides only the bitcode tells.
        """
        if not self._unread:
            return int(super().get_pointer_to_function(name))
        return int(self._codegen._engine.get_function_address(name))
