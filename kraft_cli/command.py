"""Class of all commands: their page of help, and errors of usage that name them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer
from typer.core import TyperCommand


class Command(TyperCommand):
    """Command whose page of help names arguments as these pages write them, and that all its errors of usage name."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; errors that the parser raises without their context get it."""
        try:
            return super().parse_args(ctx, args)
        except typer.TyperException as error:
            if getattr(error, "ctx", ctx) is None:
                vars(error)["ctx"] = ctx
            raise

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Words of the line of usage after the command: in brackets what may be left out."""
        return ["[OPTIONS]", *(_usage(argument) for argument in self._arguments(ctx))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write what arguments and options mean; of an argument the name alone, without its type in Python."""
        arguments = list(self._arguments(ctx))
        records = [(parameter, parameter.get_help_record(ctx)) for parameter in self.get_params(ctx)]
        described = [(parameter, record) for parameter, record in records if record is not None]
        sections = {
            "Arguments": [(each.metavar, record[1]) for each, record in described if each in arguments],
            "Options": [record for each, record in described if each not in arguments],
        }
        for title, rows in sections.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def _arguments(self, ctx: Any) -> Iterator[Any]:
        return (parameter for parameter in self.get_params(ctx) if parameter.param_type_name == "argument")


def _usage(argument: Any) -> str:
    """Argument in the line of usage: `A`, `[A]`, `A...`, `[A...]`, or `{a|b}` for words to choose from."""
    name = f"{{{argument.metavar}}}" if "|" in argument.metavar else argument.metavar
    several = f"{name}..." if argument.nargs != 1 else name
    return several if argument.required else f"[{several}]"
