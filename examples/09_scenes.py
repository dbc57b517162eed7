"""Random scenes for fast robots: race tracks as occupancy maps, and rooms of posts.

    python examples/09_scenes.py track FOLDER --seed 3
    python examples/09_scenes.py posts FOLDER --seed 3

Both write a scenario for kraft into the folder; a track also its map, in the format of ROS's map_server.  The bundled
scenes `track` and `posts` have the seed 0.
"""

import argparse
import math
from pathlib import Path

import numpy as np

RESOLUTION = 0.05  # m
TRACK = (12.0, 8.0)  # size of a track's map, m
HALF_WIDTH = 0.75  # half the width of the lane, m
WALL = 0.15  # thickness of the walls along the lane, m
ROOM = 9.0  # side of a room of posts, m
POSTS = 22
GAP = 0.95  # between two posts, and between a post and a wall, m: a robot 0.43 m wide fits through with a margin
FREE = 1.1  # distance from start and goal to the next post, m


def centre_line(seed: int) -> np.ndarray:
    """Closed centre line (720, 2) of a track: an ellipse with random waves, nowhere too narrow a bend."""
    generator = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)
    while True:
        waves = sum(
            generator.uniform(-1, 1) / k * np.cos(k * angle + generator.uniform(0, 2 * math.pi)) for k in (2, 3, 4, 5)
        )
        line = np.column_stack([4.6 * np.cos(angle), 2.6 * np.sin(angle)]) * (1.0 + 0.16 * waves)[:, None]
        along = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
        heading = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
        curvature = np.gradient(heading) / (0.5 * np.hypot(*along.T))
        inside = np.abs(line) < np.array(TRACK) / 2 - HALF_WIDTH - 2 * WALL
        if np.abs(curvature[5:-5]).max() < 1.0 and inside.all() and clear_of_itself(line):
            return line + np.array(TRACK) / 2


def clear_of_itself(line: np.ndarray) -> bool:
    """Whether the lanes of two parts of the line are apart, so that a wall fits between them."""
    coarse = line[::6]
    apart = np.hypot(*(coarse[:, None] - coarse[None, :]).transpose(2, 0, 1))
    steps = np.abs(np.arange(len(coarse))[:, None] - np.arange(len(coarse))[None, :])
    length = np.hypot(*np.diff(coarse, axis=0).T).mean()
    far = np.minimum(steps, len(coarse) - steps) * length > 2.5 * (2 * HALF_WIDTH + WALL)
    return bool(apart[far].min() > 2 * HALF_WIDTH + WALL)


def write_track(folder: Path, name: str, seed: int) -> Path:
    """Write map and scenario of a lap: the start line is a wall, the goal is behind it."""
    line = centre_line(seed)
    columns, rows = (round(size / RESOLUTION) for size in TRACK)
    x, y = (np.arange(columns) + 0.5) * RESOLUTION, (np.arange(rows) + 0.5) * RESOLUTION
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    distance = np.full((rows, columns), np.inf)
    for point in line:
        distance = np.minimum(distance, np.hypot(*(grid - point).transpose(2, 0, 1)))
    free = distance < HALF_WIDTH
    wall = ~free & (distance < HALF_WIDTH + WALL)
    image = np.where(wall, 0, 254).astype(np.uint8)[::-1]  # the first row of an image is its top
    maps = folder / "maps"
    maps.mkdir(parents=True, exist_ok=True)
    (maps / f"{name}.pgm").write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes())
    (maps / f"{name}.yaml").write_text(
        f"image: {name}.pgm\nresolution: {RESOLUTION}\norigin: [0.0, 0.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    ahead = line[1] - line[-1]
    heading = math.degrees(math.atan2(ahead[1], ahead[0]))
    length = float(np.hypot(*np.diff(line, axis=0, append=line[:1]).T).sum())
    steps = length / len(line)
    start, goal = line[round(0.7 / steps)], line[-round(0.9 / steps)]
    begin = line[round(0.7 / steps) + 1] - line[round(0.7 / steps) - 1]
    begin_deg = math.degrees(math.atan2(begin[1], begin[0]))
    scenario = f"""# yaml-language-server: $schema=scenario.schema.json
# Written by examples/09_scenes.py track --seed {seed}: a lap of {length:.1f} m on a lane {2 * HALF_WIDTH:g} m wide.
name: {name}
description: A lap on a race track from an occupancy map, for an F1TENTH car

bounds:
  x: [0, {TRACK[0]:g}]
  y: [0, {TRACK[1]:g}]

obstacles:
  - {{name: track, map: {{file: maps/{name}.yaml}}}}
  - name: start line
    box: {{center: [{line[0][0]:.3f}, {line[0][1]:.3f}], size: [0.1, {2 * HALF_WIDTH:g}], yaw_deg: {heading:.1f}}}

start: {{x: {start[0]:.3f}, y: {start[1]:.3f}, heading_deg: {begin_deg:.1f}, speed: 0}}
goal: {{center: [{goal[0]:.3f}, {goal[1]:.3f}], radius: 0.4}}

vehicle: f1tenth

sensing: {{preset: planar, camera: [{TRACK[0] / 2:g}, {TRACK[1] / 2:g}, 6], rate_hz: 50}}
trial: {{timeout: 60, oneshot_timeout: 30}}
"""
    path = folder / f"{name}.yaml"
    path.write_text(scenario)
    return path


def write_posts(folder: Path, name: str, seed: int) -> Path:
    """Write the scenario of a room of posts, from one corner to the other."""
    generator = np.random.default_rng(seed)
    half = ROOM / 2
    start, goal = np.array([-half + 0.8, -half + 0.8]), np.array([half - 0.8, half - 0.8])
    posts: list[tuple[float, float, float]] = []
    for _ in range(20_000):
        radius = float(generator.uniform(0.08, 0.3))
        x, y = generator.uniform(-half + radius + GAP, half - radius - GAP, 2).tolist()
        near = min(math.dist((x, y), start), math.dist((x, y), goal)) - radius
        if near > FREE and all(math.dist((x, y), post[:2]) > radius + post[2] + GAP for post in posts):
            posts.append((x, y, radius))
        if len(posts) == POSTS:
            break
    circles = "\n".join(
        f"  - {{name: post {k}, circle: {{center: [{x:.3f}, {y:.3f}], radius: {r:.3f}}}}}"
        for k, (x, y, r) in enumerate(posts, 1)
    )
    scenario = f"""# yaml-language-server: $schema=scenario.schema.json
# Written by examples/09_scenes.py posts --seed {seed}.
name: {name}
description: A room with {len(posts)} posts, for a differential-drive robot

bounds:
  x: [{-half:g}, {half:g}]
  y: [{-half:g}, {half:g}]

obstacles:
  - {{name: left wall, box: {{center: [{-half:g}, 0], size: [0.1, {ROOM:g}]}}}}
  - {{name: right wall, box: {{center: [{half:g}, 0], size: [0.1, {ROOM:g}]}}}}
  - {{name: near wall, box: {{center: [0, {-half:g}], size: [{ROOM:g}, 0.1]}}}}
  - {{name: far wall, box: {{center: [0, {half:g}], size: [{ROOM:g}, 0.1]}}}}
{circles}

start: {{x: {start[0]:g}, y: {start[1]:g}, heading_deg: 45, speed: 0}}
goal: {{center: [{goal[0]:g}, {goal[1]:g}], radius: 0.3}}

vehicle: jackal

sensing: {{preset: planar, camera: [0, 0, 6], rate_hz: 50}}
trial: {{timeout: 60, oneshot_timeout: 30}}
"""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.yaml"
    path.write_text(scenario)
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("track", "posts"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name")
    chosen = parser.parse_args()
    write = {"track": write_track, "posts": write_posts}[chosen.kind]
    print(write(chosen.folder, chosen.name or chosen.kind, chosen.seed))
