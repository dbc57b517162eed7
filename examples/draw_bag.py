"""Draw a bag of a drive as the layout docs/kraft-layout.json shows it in a viewer: the scene from above, commands, log.

kraft run boxes --bag run.mcap
python examples/draw_bag.py run.mcap run.png 7.5
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from rosbags.highlevel import AnyReader

mpl.use("Agg")
import matplotlib.pyplot as plt


def read(path: Path) -> dict[str, list[tuple[float, Any]]]:
    """Messages by topic, with their time from the beginning of the bag, s."""
    found = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found[connection.topic].append((1e-9 * (time - reader.start_time), message))
    return found


def newest(messages: list[tuple[float, Any]], time: float) -> Any:
    """The last message until a time (s), or the first one."""
    return max((each for each in messages if each[0] <= time), key=lambda each: each[0], default=messages[0])[1]


def yaw(turn: Any) -> float:
    """Heading of an orientation about the vertical axis, rad."""
    return 2.0 * float(np.arctan2(turn.z, turn.w))


def scene(axes: Any, bag: dict[str, list[tuple[float, Any]]], time: float) -> None:
    """Map, tree, plan, contingency, poses and the footprint at a time (s), from above."""
    grid = newest(bag["/map"], time)
    info = grid.info
    x, y = info.origin.position.x, info.origin.position.y
    cells = np.reshape(grid.data, (info.height, info.width))
    extent = x, x + info.width * info.resolution, y, y + info.height * info.resolution
    axes.imshow(cells, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=160)
    for marker in newest(bag["/markers/scene"], time).markers:
        if marker.type == 3:  # a cylinder: the goal, or a round obstacle
            place = marker.pose.position
            axes.add_patch(plt.Circle((place.x, place.y), 0.5 * marker.scale.x, color="#1a994d", alpha=0.5))
    for marker in newest(bag["/markers"], time).markers:
        if marker.ns == "tree":
            ends = np.array([(point.x, point.y) for point in marker.points]).reshape(-1, 2, 2)
            axes.plot(ends[:, :, 0].T, ends[:, :, 1].T, color="#333340", alpha=0.25, lw=0.5)
        elif marker.text:
            place = marker.pose.position
            axes.text(place.x + 0.25, place.y, marker.text, fontsize=8)
    seen = np.array([(each.pose.position.x, each.pose.position.y) for at, each in bag["/pose"] if at <= time])
    axes.plot(*seen.T, ".", color="#888888", ms=2, label="measured poses")
    for name, colour in (("/plan", "#2a6fdb"), ("/contingency", "#e07b1f")):
        path = np.array([(each.pose.position.x, each.pose.position.y) for each in newest(bag[name], time).poses])
        if len(path):
            axes.plot(*path.T, color=colour, lw=2, label=name[1:])
    pose = newest(bag["/odometry/filtered"], time).pose.pose
    corners = np.array([(point.x, point.y) for point in newest(bag["/footprint"], time).polygon.points])
    c, s = np.cos(yaw(pose.orientation)), np.sin(yaw(pose.orientation))
    outline = corners @ np.array([[c, s], [-s, c]]) + (pose.position.x, pose.position.y)
    axes.add_patch(plt.Polygon(outline, fill=False, edgecolor="#7d3cc8", lw=1.5, label="footprint"))
    axes.set(xlabel="x (m)", ylabel="y (m)", title=f"{time:.1f} s", aspect="equal")
    axes.legend(loc="upper right", fontsize=7)


def main(bag_file: str, picture: str, time: float) -> None:
    """Draw the bag at a time (s) into a picture."""
    bag = read(Path(bag_file))
    figure = plt.figure(figsize=(9.0, 6.4), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.25))
    scene(left.subplots(), bag, time)
    commands, speed, log = right.subplots(3, 1, height_ratios=(1.0, 1.0, 0.55))
    at = [each[0] for each in bag["/drive"]]
    commands.plot(at, [each.drive.speed for _, each in bag["/drive"]], label="throttle or speed")
    commands.plot(at, [each.drive.steering_angle for _, each in bag["/drive"]], label="steering (rad)")
    for name, label in (("/odometry/filtered", "estimated"), ("/truth/odom", "true")):
        if name in bag:
            speed.plot(
                [each[0] for each in bag[name]], [each.twist.twist.linear.x for _, each in bag[name]], label=label
            )
    commands.set(title="commands")
    speed.set(title="speed (m/s)", xlabel="time (s)")
    for axes in (commands, speed):
        axes.axvline(time, color="#7d3cc8", lw=1)
        axes.legend(fontsize=7)
    log.axis("off")
    lines = [f"{at:6.2f} s  {message.msg}" for at, message in bag["/rosout"]]
    log.text(0.0, 1.0, "\n".join(["log", *lines[-5:]]), va="top", fontsize=8, family="monospace")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    if len(sys.argv) != 4 or not Path(sys.argv[1]).exists():
        sys.exit("expected a bag that exists, a picture and a time in s, as in: draw_bag.py run.mcap run.png 7.5")
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
