"""Controllers of the user's own: a class in Python that a method file names, driven like every other controller.

The class is made with the vehicle's model and the settings of the method, and has one function:

    class PurePursuit:
        def __init__(self, model: VehicleModel, lookahead: float = 0.5) -> None: ...
        def command(self, estimate: Estimate, reference: Reference) -> Floats: ...

It may have two more: `set_map(solver)`, called before the first command and whenever the map or the goal changes, and
`set_seed(seed)`, called once.  Contingencies are tracked by the law of the other methods, and commands are clamped.
"""

from __future__ import annotations

import copy
import hashlib
import inspect
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from kraft.config.user_code import described, imported, line_of, place_of
from kraft.driving.control_settings import UserCode
from kraft.driving.messages import Controller, Estimate, Reference, ReferenceKind
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, Diagnostic, InputError, UserCodeError
from kraft.text import suggestion
from ompl_ext.arrays import Floats
from ompl_ext.solver import DirtSolver

_EXPECTED: Final = "expected code that defines a class with the function command(self, estimate, reference)"
CODE_HASH: Final = "code_sha256"
"""Key of the SHA-256 of the file."""


def user_class(settings: UserCode) -> type[Any]:
    """Class that the settings name.

    Raises:
        InputError: if the code cannot be imported, or has no such class, or the class has no function `command`.
    """
    subject = settings.code
    module, name = imported(subject, subject, _EXPECTED)
    found = getattr(module, name, None)
    if found is None:
        classes = [key for key, value in vars(module).items() if inspect.isclass(value) and hasattr(value, "command")]
        expected = suggestion(name, classes, none=_EXPECTED)
        raise InputError.of(subject, f"there is no {name} in {place_of(module)}", expected, Code.NOT_FOUND)
    if not inspect.isclass(found) or not callable(getattr(found, "command", None)):
        what = f"the class {name} without `command`" if inspect.isclass(found) else f"of type {type(found).__name__}"
        raise InputError.of(subject, f"{name} is {what}", _EXPECTED, Code.TYPE)
    return found


def uses_map(settings: UserCode) -> bool:
    """Whether the class wants the map, see `user_class`."""
    return hasattr(user_class(settings), "set_map")


def check_arguments(settings: UserCode) -> None:
    """Check that the class takes the settings.

    Raises:
        InputError: if not, or see `user_class`.
    """
    named = user_class(settings)
    try:
        inspect.signature(named).bind(None, **settings.settings)
    except ValueError:  # a class in C has no signature: it is found out when it is made
        return
    except TypeError as error:
        expected = f"expected {named.__name__}{inspect.signature(named)}, with the vehicle's model first"
        raise InputError.of(settings.code, f"does not take its settings: {error}", expected, Code.CODE) from None


def code_content(settings: UserCode) -> dict[str, Any]:
    """What results depend on of the code: names of its file and class, and the SHA-256 of the file.

    Raises:
        InputError: see `user_class`.
    """
    module, name = imported(settings.code, settings.code, _EXPECTED)
    file = Path(place_of(module))
    return {"code": f"{file.name}:{name}", CODE_HASH: hashlib.sha256(file.read_bytes()).hexdigest()}


class UserController:
    """Calls a class of the user's own while the reference is a plan, and `law` while it is a contingency."""

    def __init__(
        self, settings: UserCode, model: VehicleModel, law: Controller, dirt: DirtSolver | None, seed: int
    ) -> None:
        """Make the class for the vehicle of `model`, with the map of `dirt` if it wants it.

        Raises:
            InputError: if it cannot be imported, does not take its settings, or wants a map and there is none.
            UserCodeError: if it raises an error.
        """
        check_arguments(settings)
        named = user_class(settings)
        self._name, self._reference, self._model, self.law, self._dirt = named.__name__, settings.code, model, law, dirt
        self._shown: tuple[Reference, Reference] | None = None
        takes = f"expected {named.__name__}{inspect.signature(named)} to take the vehicle's model"
        self._own: Any = self._result_of(
            lambda: named(model, **settings.settings), f"in making {named.__name__}", takes
        )
        if hasattr(self._own, "set_seed"):
            self._result_of(
                lambda: self._own.set_seed(seed), f"in set_seed of {named.__name__}", "expected it to take a number"
            )
        if hasattr(self._own, "set_map") and dirt is None:
            expected = "expected a class without set_map, which tracks plans"
            raise InputError.of(settings.code, "has set_map, which needs the map", expected, Code.CONFLICT)
        if dirt is not None:
            self.set_map(dirt)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy the state of the class and of the law; share model and map."""
        result = copy.copy(self)
        memo[id(self._dirt)] = self._dirt
        copied = "expected attributes that copy.deepcopy copies, or a function __deepcopy__"
        result._own = self._result_of(
            lambda: copy.deepcopy(self._own, memo), f"in copying {self._name} for a prediction", copied
        )
        result.law = copy.deepcopy(self.law, memo)
        return result

    def set_map(self, dirt: DirtSolver) -> None:
        """Give the map of another solver to the class, if it wants it."""
        self._dirt = dirt
        if hasattr(self._own, "set_map"):
            expected = "expected it to take the planner's solver"
            self._result_of(lambda: self._own.set_map(dirt), f"in set_map of {self._name}", expected)

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) that the class returns for the estimate's time, clamped to the bounds.

        Raises:
            UserCodeError: if it raises an error, or does not return a number for each control.
        """
        if reference.kind is ReferenceKind.CONTINGENCY:
            return self.law.command(estimate, reference)
        own = replace(estimate, state=estimate.state.copy())  # which it may change, as the reference
        names = ", ".join(self._model.vehicle.controls)
        where = f"in command of {self._name} at {estimate.time:.2f} s"
        expected = f"expected a finite number for each of {names}"
        returned = self._result_of(lambda: self._own.command(own, self._copy_of(reference)), where, expected)
        return self._model.clamped(self._checked(returned, where, expected))

    def _copy_of(self, reference: Reference) -> Reference:
        """Copy of a reference, the same one while the reference is the same."""
        if self._shown is None or self._shown[0] is not reference:
            times, states, controls = reference.times.copy(), reference.states.copy(), reference.controls.copy()
            copied = replace(reference, times=times, states=states, controls=controls, rest=reference.rest.copy())
            self._shown = reference, copied
        return self._shown[1]

    def _checked(self, returned: Any, where: str, expected: str) -> Floats:
        """The returned control (nu,) as numbers."""
        try:
            control: Floats = np.asarray(returned, dtype=np.float64)
        except (TypeError, ValueError):
            control = np.zeros(0)
        if control.shape != (len(self._model.vehicle.controls),) or not np.isfinite(control).all():
            raise UserCodeError.of(self._reference, f"returned {returned!r} {where}", expected, Code.CODE)
        return control

    def _result_of(self, call: Callable[[], Any], where: str, expected: str) -> Any:
        """Result of a call of the user's code; its errors are said with their line, `where` and what is `expected`.

        Raises:
            UserCodeError: if the code raises anything.
        """
        try:
            return call()
        except (Exception, SystemExit) as error:  # the user's code may raise anything
            file, line = line_of(error) or (self._reference, None)
            problem = f"{described(error)}, {where}"
            raise UserCodeError([Diagnostic(file, problem, expected, line=line, code=Code.CODE)]) from error
