"""Derivative of a vehicle as a CasADi expression, from the source of its Python functions.

The functions are executed with symbols instead of numbers.  Conditional expressions, `and`, `or`, `not`, `min`, `max`
and `abs` become their symbolic counterparts; statements that branch on the state cannot be written as an expression.

Andersson, Gillis, Horn, Rawlings, Diehl: CasADi, 2019.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import textwrap
from collections.abc import Callable
from functools import reduce
from types import ModuleType, SimpleNamespace
from typing import Any, Final

from ompl_ext import trigonometry
from ompl_ext.vehicle import Vehicle

FUNCTIONS: Final = ("sin", "cos", "tan", "atan", "atan2", "sqrt", "exp", "log", "sinh", "cosh", "tanh", "asin", "acos")
"""Functions of `math` and of `ompl_ext` that have the same name in CasADi."""


class NotSymbolicError(ValueError):
    """A function of a vehicle has no source, is not defined by a `def` statement, or branches by statements."""


def symbolic_derivative(vehicle: Vehicle, casadi: Any) -> Callable[[Any, Any, Any], Any]:
    """Function of state (nx), control (nu) and parameters (np), all symbols of `casadi`, that returns dx/dt.

    Raises:
        NotSymbolicError: if the derivative cannot be written as an expression.
    """
    nx, nu, count = len(vehicle.state), len(vehicle.controls), len(vehicle.parameter_array)

    def derivative(x: Any, u: Any, p: Any) -> Any:
        parameters = tuple(p[k] for k in range(count))
        inputs = tuple(u[k] for k in range(nu))
        if vehicle.actuation is not None:
            inputs = _traced(vehicle.actuation, casadi, {})(inputs, parameters)
        rates = _traced(vehicle.derivative, casadi, {})(tuple(x[k] for k in range(nx)), inputs, parameters)
        return casadi.vertcat(*rates)

    try:
        derivative(casadi.SX.sym("x", nx), casadi.SX.sym("u", nu), casadi.SX.sym("p", count))
    except (OSError, TypeError, RuntimeError, SyntaxError) as error:
        raise NotSymbolicError(str(error)) from error
    return derivative


def _traced(function: Any, ca: Any, known: dict[int, Any]) -> Any:
    """A function of a vehicle, for symbols; `known` are those that were traced already."""
    plain = getattr(function, "py_func", function)
    if id(plain) in known:
        return known[id(plain)]
    tree = _Symbolic().visit(ast.parse(textwrap.dedent(inspect.getsource(plain))))
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise NotSymbolicError(f"{plain.__name__} is not a plain function")
    definition.decorator_list = []
    definition.returns = None
    for argument in definition.args.args:
        argument.annotation = None
    cells = plain.__closure__ or ()
    scope = {
        **plain.__globals__,
        **dict(zip(plain.__code__.co_freevars, (c.cell_contents for c in cells), strict=True)),
    }
    names = {node.id for node in ast.walk(definition) if isinstance(node, ast.Name)}
    values = {name: _value(scope[name], ca, known) for name in sorted(names) if name in scope}
    space = {**values, **_symbolic_builtins(ca)}
    exec(compile(ast.fix_missing_locations(tree), inspect.getfile(plain), "exec"), space)
    known[id(plain)] = space[plain.__name__]
    return known[id(plain)]


def _value(value: Any, ca: Any, known: dict[int, Any]) -> Any:
    """A global of a traced function: the symbolic counterpart of a function, and anything else as it is."""
    name = getattr(value, "__name__", "")
    ours = name in FUNCTIONS and getattr(trigonometry, name, None) is value
    if ours or (name in FUNCTIONS and getattr(math, name, None) is value):
        return getattr(ca, name)
    if isinstance(value, ModuleType):
        found = {each: getattr(ca, each) for each in FUNCTIONS if hasattr(value, each)}
        found |= {each: getattr(value, each) for each in ("pi", "tau", "inf") if hasattr(value, each)}
        return SimpleNamespace(**found) if name in ("math", "numpy", "ompl_ext", trigonometry.__name__) else value
    if hasattr(getattr(value, "py_func", value), "__code__"):
        return _traced(value, ca, known)
    return value


def _symbolic_builtins(ca: Any) -> dict[str, Any]:
    return {
        "__builtins__": builtins,
        "_if_else": lambda test, yes, no: ca.if_else(test, yes, no) if _is_symbol(ca, test) else (yes if test else no),
        "_and": lambda *tests: reduce(ca.logic_and, tests),
        "_or": lambda *tests: reduce(ca.logic_or, tests),
        "_not": ca.logic_not,
        "abs": ca.fabs,
        "min": lambda *values: reduce(ca.fmin, values),
        "max": lambda *values: reduce(ca.fmax, values),
    }


def _is_symbol(ca: Any, value: Any) -> bool:
    return isinstance(value, ca.SX | ca.MX | ca.DM)


class _Symbolic(ast.NodeTransformer):
    """Replaces what Python decides at once by calls that may return an expression."""

    def visit_IfExp(self, node: ast.IfExp) -> ast.AST:
        self.generic_visit(node)
        return _call("_if_else", node.test, node.body, node.orelse)

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        self.generic_visit(node)
        return _call("_and" if isinstance(node.op, ast.And) else "_or", *node.values)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        self.generic_visit(node)
        return _call("_not", node.operand) if isinstance(node.op, ast.Not) else node


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])
