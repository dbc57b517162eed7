"""What the server of `benchmarks.drive_server` imports and loads before it forks."""

from kraft.robot.planner import Planner
from kraft.robot.tracker import warm_up
from kraft_cli.work.drive import DriveRequest, resolve

_SPEC = resolve(DriveRequest("boxes", "sim"))
_START = _SPEC.task.start
warm_up(_SPEC)
Planner(_SPEC).begin((_START.x, _START.y, _START.heading))
