"""Arrays without their reference count, for the inside of hot loops."""

from __future__ import annotations

from typing import Any

from numba import extending
from numba.core import cgutils

intrinsic: Any = extending.intrinsic
"""Numba's own; callers leave out the first argument, which mypy cannot know."""


@intrinsic  # type: ignore[untyped-decorator]  # numba's own types
def bare(typing_context: Any, array: Any) -> Any:
    """The same array without its reference count, which numba would touch at every call in a loop.

    Only for arguments of a function called from Python: the caller holds them until it returns.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        proxy: Any = cgutils.create_struct_proxy(signature.args[0])  # type: ignore[no-untyped-call]  # numba has no types
        view = proxy(context, builder, value=arguments[0])
        view.meminfo = cgutils.get_null_value(view.meminfo.type)  # type: ignore[no-untyped-call]  # as above
        view.parent = cgutils.get_null_value(view.parent.type)  # type: ignore[no-untyped-call]  # as above
        return view._getvalue()

    return array(array), codegen
