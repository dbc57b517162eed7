"""What people type and import: it stays as it is, or is changed on purpose, here and in the documentation."""

from __future__ import annotations

from importlib import import_module

import pytest
import typer

from kraft_cli.app import app

IMPORTS = [
    "kraft.evaluation:compare",
    "kraft.evaluation:evaluate",
    "kraft.evaluation:markdown",
    "kraft.logs.reader:read_logs",
    "kraft.planning:plan_task",
    "kraft.recording.recorder:Recorder",
    "kraft.scenario:load_scenario",
    "kraft.scenario:parse_scenario",
    "kraft.simulation:World",
    "kraft.sysid:Settings",
    "kraft.sysid:identify",
    "kraft.sysid:prediction_errors",
    "kraft.trial:run_trial",
    "kraft.vehicles.benchmark:BENCHMARK",
    "kraft.vehicles.mushr:MUSHR",
    "kraft.vehicles.mushr:MUSHR_DRIVE",
    "kraft.vehicles.mushr:MUSHR_LAG",
    "kraft.vehicles.unicycle2:UNICYCLE2",
    "kraft.video.recorder:VideoRecorder",
    "ompl_ext.obstacles:Workspace",
    "ompl_ext.obstacles:box",
    "ompl_ext.planner:DIRT",
    "ompl_ext.query:Goal",
    "ompl_ext.query:Safety",
    "ompl_ext.solver:DirtSolver",
    "ompl_ext.system:simple_setup",
    "ompl_ext.trigonometry:cos",
    "ompl_ext.trigonometry:sin",
    "ompl_ext.validity:SafetyValidityChecker",
    "ompl_ext.vehicle:Footprint",
    "ompl_ext.vehicle:Vehicle",
    "ompl_ext.vehicle:derivative",
]

COMMANDS = {
    "compare": "a b --json",
    "doctor": "--json --remove-kernels --robot",
    "drive": "scenario --bag --json --method --out --robot --seed --set --vehicle",
    "eval": "scenarios --cluster --jobs --json --methods --out --realtime --resume --seed --set --suite --trials --vary --vehicle",
    "generate": "kind --count --density --json --out --seed --vehicle",
    "import": "kind sources --goal --json --out --skip --start --vehicle",
    "list": "what --json",
    "plan": "scenario --after --from --iterations --json --out --param --planner --plot --seed --set --threads --time --vehicle",
    "record": "scenario --bag --commands --for --json --out --resume --runs --seed --vehicle",
    "report": "results --out --serve",
    "run": "scenario --bag --json --method --out --plot --realtime --seed --set --vehicle --video --view",
    "sysid": "logs --area --commands --extras --freeze --graph --holdout --horizon --json --mapping --model --next --out "
    "--param --plot --pose-noise",
    "validate": "files --json",
    "world": "scenario --json --robot --seed --set --speed --vehicle --video --view",
}


@pytest.mark.parametrize("path", IMPORTS)
def test_what_programs_import_stays_where_it_is(path: str) -> None:
    module, name = path.split(":")
    assert hasattr(import_module(module), name)


def test_commands_keep_their_arguments_and_options() -> None:
    program = typer.main.get_command(app)
    found = {}
    for name, command in program.commands.items():
        names = [option for parameter in command.params for option in parameter.opts]
        arguments = [n for n in names if not n.startswith("-")]
        found[name] = " ".join([*arguments, *sorted(n for n in names if n.startswith("--"))])
    assert found == COMMANDS
