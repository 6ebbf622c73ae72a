"""A compiler for functions that are only inlined: half the work of numba's own.

numba optimises every function for itself and makes machine code of it, then inlines the optimised
form in each caller and optimises that again. Nothing calls the machine code of an inlined function.
Here it is left out, and the code is optimised once, in the kernel that Python calls.
"""

from __future__ import annotations

import llvmlite.binding
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder

__all__ = ["InlinedCompiler"]

#: How names of variables begin that hold the environment of a compiled function.
_ENVIRONMENT = "_ZN08NumbaEnv"


class _InlinedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of an inlined function and of what it calls, as numba made it."""

    def _optimize_final_module(self) -> None:
        """Leave the code to the caller."""

    def _finalize_final_module(self) -> None:
        """Make no machine code, but the variables of environments, which numba sets."""
        self._finalize_dynamic_globals()
        names = (variable.name for variable in self._final_module.global_variables)
        text = "\n".join(
            f'@"{name}" = common global i8* null' for name in names if name.startswith(_ENVIRONMENT)
        )
        self._environments = self.codegen.create_library(f"{self.name}.environments")
        self._environments.add_llvm_module(llvmlite.binding.parse_assembly(text))
        self._environments.finalize()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return zero: there is no machine code."""
        self._ensure_finalized()
        return 0


class InlinedCompiler(CompilerBase):  # type: ignore[misc]
    """numba's compiler with `_InlinedLibrary` as the place of the code."""

    def define_pipelines(self) -> list[object]:
        """Return the usual pipeline."""
        state = self.state
        state.library = _InlinedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return [DefaultPassBuilder.define_nopython_pipeline(state)]
