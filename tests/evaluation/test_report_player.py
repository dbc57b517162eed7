"""Replays of `report.html` in a real browser: what they show, how they are played, and where they come from."""

from __future__ import annotations

import json
import shutil
import threading
import urllib.request
from pathlib import Path
from urllib.error import HTTPError

import numpy as np
import pytest
from playwright.sync_api import Page
from support.paths import ROOT
from support.replays import unpacked, values_of
from support.report_page import CHROMIUM, Driven, car, needs_chromium, open_trial, seek, shown

from kraft.evaluation.journal import REPLAYS
from kraft.evaluation.replay import packed, series
from kraft.evaluation.report import write_report
from kraft.evaluation.report.server import ReportServer
from kraft_cli.work.run import run_command

pytestmark = needs_chromium


def test_a_link_opens_a_trial_and_the_numbers_under_the_cursor_are_the_recorded_ones(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    row = next(row for row in driven.evaluation.rows if row.key == ("turns", "kraft", 0))
    assert tab.inner_text("#replay-title") == "turns, KRAFT, seed 0"
    assert f"{row.outcome} after {row.t_s:.2f} s" in tab.inner_text("#replay-outcome")
    drive = driven.drive("kraft", 0)
    times, speeds, clearances = (values_of(drive[name]) for name in ("t", "speed", "clearance"))
    k = len(times) // 2 // drive["every"] * drive["every"]
    seek(tab, times[k])
    assert shown(tab, "speed") == pytest.approx(speeds[k], abs=0.006)
    assert shown(tab, "clearance") == pytest.approx(clearances[k // drive["every"]], abs=0.001)
    assert row.min_clearance_m is not None
    assert row.min_clearance_m - 0.001 <= min(clearances) <= row.min_clearance_m + 0.03


def test_a_replay_plays_pauses_steps_and_goes_to_other_trials(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    begin = car(tab)
    tab.select_option("#replay-speed", "0.25")
    tab.click("#replay-play")
    tab.wait_for_function("d => document.querySelector('#stage .car.body').getAttribute('d') !== d", arg=begin)
    assert tab.inner_text("#replay-play") == "pause"
    tab.keyboard.press("Space")
    assert tab.inner_text("#replay-play") == "play"
    tab.select_option("#replay-speed", "8")
    tab.click("#replay-play")
    tab.wait_for_function("() => document.getElementById('replay-play').textContent === 'play'")
    now, _, end, _ = tab.inner_text("#replay-clock").split()
    assert now == end
    seek(tab, 0.0)
    cycles = driven.drive("kraft", 0)["cycles"]
    for cycle in cycles[1:4]:
        tab.keyboard.press("ArrowRight")
        assert float(tab.input_value("#replay-time")) == pytest.approx(cycle["t"], abs=0.01)
    tab.keyboard.press("ArrowLeft")
    assert f"cycle 3 of {len(cycles)}" in (tab.get_attribute("#replay-time", "aria-valuetext") or "")
    for layer in ("plan", "tree", "believed", "seen", "trail"):
        assert len(tab.get_attribute(f"#stage .{layer}", "d") or "") > 10, layer
    tab.keyboard.press("Shift+ArrowRight")
    tab.wait_for_function("() => document.getElementById('replay-title').textContent.endsWith('seed 1')")
    assert tab.evaluate("location.hash") == "#trial=turns/kraft/1"
    tab.keyboard.press("Escape")
    tab.wait_for_selector("#replay", state="hidden")
    tab.wait_for_function("() => location.hash === ''")  # the dialog's close event follows once it is hidden


def test_the_legend_has_a_scale_and_the_obstacle_that_was_hit(tab: Page, driven: Driven) -> None:
    hit = next(row for row in driven.evaluation.rows if row.outcome == "collision")
    open_trial(tab, driven.url, hit.method, hit.seed)
    assert tab.is_visible("#replay-hit")
    for width in (1280, 500):
        tab.set_viewport_size({"width": width, "height": 800})
        length, unit = tab.inner_text("#replay-scale").split()
        assert unit == "m"
        car_length = driven.drive(hit.method, hit.seed)["footprint"][1]
        drawn = tab.evaluate(
            "() => { const [front, , , back] = document.querySelector('#stage .car.body').getAttribute('d')"
            ".match(/-?[0-9.]+ -?[0-9.]+/g).map(each => DOMPoint.fromPoint((([x, y]) => ({x, y}))(each.split(' ')))"
            ".matrixTransform(document.querySelector('#stage g').getScreenCTM()));"
            " return Math.hypot(front.x - back.x, front.y - back.y); }"
        )
        bar = tab.evaluate("() => document.querySelector('#replay-scale .scale').getBoundingClientRect().width")
        assert bar / float(length) == pytest.approx(drawn / car_length, rel=0.05)
    open_trial(tab, driven.url)
    assert not tab.is_visible("#replay-hit")


def test_the_space_bar_presses_the_button_that_has_the_focus(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    tab.focus("#replay-forward")
    tab.keyboard.press("Space")
    second = driven.drive("kraft", 0)["cycles"][1]["t"]
    assert float(tab.input_value("#replay-time")) == pytest.approx(second, abs=0.01)
    assert tab.inner_text("#replay-play") == "play"
    tab.focus("#replay-close")
    tab.keyboard.press("Space")
    tab.wait_for_selector("#replay", state="hidden")


def test_a_replay_ends_when_the_trial_does_with_the_last_pose_that_is_recorded(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    row = next(row for row in driven.evaluation.rows if row.key == ("turns", "kraft", 0))
    last = values_of(driven.drive("kraft", 0)["t"])[-1]
    assert row.t_s is not None
    assert row.t_s > last + 0.005
    seek(tab, row.t_s + 1.0)
    assert tab.inner_text("#replay-clock") == f"{row.t_s:.2f} of {row.t_s:.2f} s"
    end = car(tab)
    seek(tab, last)
    assert car(tab) == end


def test_the_arrows_move_the_slider_that_has_the_focus_by_ticks(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    times = values_of(driven.drive("kraft", 0)["t"])
    tab.focus("#replay-time")
    for key, tick in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowUp", 3), ("ArrowLeft", 2), ("ArrowDown", 1)):
        tab.keyboard.press(key)
        assert float(tab.input_value("#replay-time")) == pytest.approx(times[tick], abs=0.006)
    tab.keyboard.press("Shift+ArrowRight")
    tab.wait_for_function("() => document.getElementById('replay-title').textContent.endsWith('seed 1')")


def test_a_failed_trial_states_its_cause_and_the_obstacle_it_hit_is_red(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url, "oneshot-openloop", 1)
    row = next(row for row in driven.evaluation.rows if row.key == ("turns", "oneshot-openloop", 1))
    assert row.outcome == "collision"
    assert row.cause is not None
    assert f"{row.cause.kind}; {row.cause.text}" in tab.inner_text("#replay-outcome")
    titles = tab.locator("#stage .hit title").all_text_contents()
    assert [title.split(":")[0] for title in titles] == [row.obstacle]


def test_a_wide_floor_plan_is_above_the_plots_and_a_tall_one_beside_them(tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": 1440, "height": 900})
    open_trial(tab, driven.url)
    boxes = "() => ['#stage', '.panel'].map(e => document.querySelector(e).getBoundingClientRect())"
    stage, panel = tab.evaluate(boxes)
    assert panel["left"] > stage["right"]
    tab.evaluate("document.querySelector('svg.floor').setAttribute('viewBox', '0 0 400 200')")
    tab.evaluate("location.hash = ''")
    tab.wait_for_selector("#replay", state="hidden")
    tab.evaluate("location.hash = '#trial=turns/kraft/0'")
    tab.wait_for_selector("#replay.landscape")
    stage, panel = tab.evaluate(boxes)
    assert panel["top"] > stage["bottom"]
    assert stage["width"] > 1000


@pytest.mark.parametrize(("plan", "least"), [("0 0 400 400", (700, 700)), ("0 0 150 400", (360, 900))])
def test_a_floor_plan_fills_a_tall_window_in_its_own_proportions(
    plan: str, least: tuple[int, int], tab: Page, driven: Driven
) -> None:
    tab.set_viewport_size({"width": 1000, "height": 1400})
    tab.goto(driven.url)
    tab.evaluate("plan => document.querySelector('svg.floor').setAttribute('viewBox', plan)", plan)
    tab.evaluate("location.hash = '#trial=turns/kraft/0'")
    tab.wait_for_selector("#plots figure")
    drawn = tab.locator("#stage svg").bounding_box()
    last = tab.locator("#plots figure").last.bounding_box()
    assert drawn is not None
    assert last is not None
    width, height = (float(size) for size in plan.split()[2:])
    assert drawn["width"] / drawn["height"] == pytest.approx(width / height, rel=0.02)
    assert (drawn["width"], drawn["height"]) >= least
    assert last["y"] + last["height"] > 1000
    assert tab.evaluate(
        "document.querySelector('.panel').scrollHeight <= document.querySelector('.panel').clientHeight"
    )


@pytest.mark.parametrize("width", [400, 1000])
def test_a_replay_is_as_wide_as_the_window_and_has_the_only_scroll_bar(width: int, tab: Page, driven: Driven) -> None:
    kind = tab.context.browser.browser_type  # type: ignore[union-attr]  (a tab has a browser)
    shows_bars = kind.launch(executable_path=CHROMIUM, args=["--no-sandbox"], ignore_default_args=["--hide-scrollbars"])
    page = shows_bars.new_page(viewport={"width": width, "height": 800})
    page.goto(driven.url)
    assert page.evaluate("document.documentElement.clientWidth") < width  # bars take room, as on a desktop
    open_trial(page, driven.url)
    seek(page, 99.0)
    edges = "all => all.map(e => e.getBoundingClientRect().right)"
    assert max(page.locator("#replay-clock, #replay-close, #replay-speed").evaluate_all(edges)) <= width - 8
    assert page.evaluate("document.documentElement.clientWidth") == width
    page.keyboard.press("Escape")
    page.wait_for_selector("#replay", state="hidden")
    assert page.evaluate("document.documentElement.clientWidth") < width
    shows_bars.close()


def test_the_legend_names_only_what_the_floor_plan_has(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    assert tab.locator("[data-thing]:visible").count() == 0
    assert not tab.locator("input[data-layer=hidden]").is_visible()
    assert [text.split("\n")[-1] for text in tab.locator(".marks li:visible").all_inner_texts()] == [
        "start, with its heading",
        "goal",
        "0.5 m",
    ]
    start, nose = (
        tab.locator(f"#stage .{name}").evaluate("e => getComputedStyle(e).fill") for name in ("start", "nose")
    )
    assert start != nose


def test_what_blocked_the_car_is_drawn_from_the_cycle_on_that_knows_it(
    tab: Page, driven: Driven, tmp_path: Path
) -> None:
    open_trial(tab, driven.url)
    entry = tab.locator("label:has(input[data-layer=blocked])")
    assert not entry.is_visible()
    folder = tmp_path / "blocked"
    shutil.copytree(driven.folder, folder)
    lines = [json.loads(line) for line in (folder / REPLAYS).read_text().splitlines()]
    for line in lines:
        drive = unpacked(line["drive"])
        for cycle in drive["cycles"][2:]:
            cycle["blocked"] = [[series(np.array(axis), 0.01) for axis in ([1.0, 1.4, 1.4, 1.0], [2.0, 2.0, 2.2, 2.2])]]
        line["drive"] = packed(drive)
    (folder / REPLAYS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    _, path = write_report(folder)
    open_trial(tab, path.as_uri())
    assert entry.is_visible()
    times = [cycle["t"] for cycle in driven.drive("kraft", 0)["cycles"]]
    seek(tab, times[1])
    assert not tab.get_attribute("#stage .blocked", "d")
    seek(tab, times[2])
    assert tab.get_attribute("#stage .blocked", "d") == "M1.000 2.000L1.400 2.000L1.400 2.200L1.000 2.200z"
    assert "1 assumed obstacle where the car was blocked" in tab.inner_text("#replay-cycle")
    entry.click()
    assert not tab.locator("#stage .blocked").is_visible()


def test_wrong_links_and_trials_without_a_replay_say_so(tab: Page, driven: Driven, tmp_path: Path) -> None:
    tab.goto(f"{driven.url}#trial=turns/kraft/99")
    assert "does not have" in tab.inner_text("#replay-problem")
    shutil.copytree(driven.folder, tmp_path / "old")
    (tmp_path / "old" / REPLAYS).unlink()
    _, path = write_report(tmp_path / "old")
    tab.goto(f"{path.as_uri()}#trial=turns/kraft/0")
    tab.wait_for_selector("#replay-problem:visible")
    assert "No replay was recorded" in tab.inner_text("#replay-problem")


def test_a_served_page_reads_replays_from_the_folder_and_from_this_machine_only(tab: Page, driven: Driven) -> None:
    with ReportServer(driven.folder, run_command) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            assert server.server_address[0] == "127.0.0.1"
            open_trial(tab, server.url)
            assert tab.locator("script[type='text/plain']").count() == 0
            tab.wait_for_function("() => document.querySelector('#stage .tree').getAttribute('d').length > 10")
            long = f"replay/drive/turns/kraft/{'9' * 5000}"
            for path, host, status in (
                ("", "evil.example", 403), ("replay/drive/turns/kraft/99", None, 404), (long, None, 404), ("../x", None, 404)
            ):  # fmt: skip
                request = urllib.request.Request(server.url + path, headers={"Host": host} if host else {})
                with pytest.raises(HTTPError) as caught:
                    urllib.request.urlopen(request)
                caught.value.close()
                assert caught.value.code == status
        finally:
            server.shutdown()
            thread.join()


def test_a_refused_clipboard_is_said_and_the_button_offers_the_link_again(tab: Page, driven: Driven) -> None:
    refuse = (
        "() => { navigator.clipboard.writeText = () => Promise.reject(new DOMException('no', 'NotAllowedError')); }"
    )
    open_trial(tab, driven.url)
    tab.evaluate(refuse)
    tab.click("#replay-link")
    tab.wait_for_function("() => document.getElementById('replay-link').textContent.startsWith('refused')")
    tab.wait_for_function("() => document.getElementById('replay-link').textContent === 'copy link'")
    tab.evaluate("() => { navigator.clipboard.writeText = async (text) => { window.copied = text; }; }")
    tab.click("#replay-link")
    tab.wait_for_function("() => document.getElementById('replay-link').textContent === 'copied'")
    assert tab.evaluate("window.copied") == tab.url


def test_at_the_ends_of_the_list_there_is_no_button_to_a_next_trial(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    assert tab.is_disabled("#replay-before")
    for _ in range(3):
        title = tab.inner_text("#replay-title")
        tab.click("#replay-after")
        tab.wait_for_function("t => document.getElementById('replay-title').textContent !== t", arg=title)
    assert tab.is_disabled("#replay-after")
    assert tab.is_enabled("#replay-before")
    tab.keyboard.press("Shift+ArrowRight")
    assert tab.inner_text("#replay-title") == "turns, OneShot + OpenLoop, seed 1"


def test_the_keys_go_on_from_a_trial_without_a_replay(tab: Page, driven: Driven, tmp_path: Path) -> None:
    folder = tmp_path / "partly"
    shutil.copytree(driven.folder, folder)
    lines = (folder / REPLAYS).read_text().splitlines(keepends=True)
    others = (line for line in lines if (json.loads(line)["method"], json.loads(line)["seed"]) != ("kraft", 1))
    (folder / REPLAYS).write_text("".join(others))
    _, path = write_report(folder)
    open_trial(tab, path.as_uri())
    tab.keyboard.press("Shift+ArrowRight")
    tab.wait_for_selector("#replay-problem:visible")
    tab.keyboard.press("Shift+ArrowRight")
    tab.wait_for_function("() => document.getElementById('replay-title').textContent.includes('OneShot')")


def test_every_plot_has_the_time_below_it(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    end = float(tab.get_attribute("#replay-time", "max") or "")
    plots = tab.locator("#plots svg")
    assert plots.count() >= 4
    for plot in plots.all():
        times = [float(text[:-2]) for text in plot.locator("text").all_text_contents() if text.endswith(" s")]
        assert times[0] == 0.0
        assert end - times[1] < times[-1] <= end
        boxes = plot.locator("text").evaluate_all("all => all.map(e => e.getBoundingClientRect().right)")
        assert max(boxes) <= plot.evaluate("e => e.getBoundingClientRect().right")


@pytest.mark.parametrize("width", [390, 1280])
def test_every_plot_has_round_values_at_its_axis_and_their_unit(width: int, tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": width, "height": 900})
    open_trial(tab, driven.url)
    units = []
    for plot in tab.locator("#plots svg").all():
        words = plot.locator("text.level").all_text_contents()
        numbers = [float(text.split()[0].replace("\N{MINUS SIGN}", "-")) for text in words]
        assert len(numbers) >= 2
        steps = np.diff(numbers)
        assert steps == pytest.approx(steps[0])
        assert f"{steps[0]:e}"[0] in "125"
        units.append(" ".join(words[-1].split()[1:]))
        left = plot.evaluate("e => e.getBoundingClientRect().left")
        assert (
            min(plot.locator("text.level").evaluate_all("all => all.map(e => e.getBoundingClientRect().left)")) >= left
        )
    assert units[:3] == ["m", "m", "m/s"]
    assert units[-1] == "rad"


def test_a_plan_is_drawn_as_a_smooth_curve_through_its_points(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    plan = driven.drive("kraft", 0)["cycles"][0]["plan"]
    points = np.stack([values_of(axis) for axis in plan], axis=1)
    drawn = tab.get_attribute("#stage .plan", "d") or ""
    ends = [[float(number) for number in part.split()[-2:]] for part in drawn.removeprefix("M").split("C")]
    assert len(ends) > 10
    for end in ends:
        assert np.hypot(*(points - end).T).min() < 0.001


def test_a_smooth_curve_has_no_loop_where_a_vehicle_reverses(tab: Page) -> None:
    tab.goto("about:blank")
    tab.add_script_tag(path=ROOT / "kraft" / "evaluation" / "report" / "replay.js")
    straight = "M0.000 0.000C0.000 0.000 0.667 0.000 1.000 0.000C1.333 0.000 2.000 0.000 2.000 0.000"
    assert tab.evaluate("curve([[0, 0], [1, 0], [1, 0], [2, 0]])") == straight
    assert "C0.000 0.000 1.000 0.100 1.000 0.100C1.000 0.100 " in tab.evaluate("curve([[0, 0], [1, 0.1], [0, 0.2]])")
    assert tab.evaluate("curve([])") == ""


@pytest.mark.parametrize("width", [390, 600, 768])
def test_the_controls_of_a_small_window_are_two_lines_at_most(width: int, tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": width, "height": 844})
    open_trial(tab, driven.url)
    middles = tab.locator("#replay .controls > *").evaluate_all(
        "all => all.map(e => e.getBoundingClientRect()).map(box => Math.round((box.top + box.bottom) / 40))"
    )
    assert len(set(middles)) <= 2
    play, speed = (tab.locator(f"#replay-{name}").bounding_box() for name in ("play", "speed"))
    assert play is not None
    assert speed is not None
    assert abs(play["y"] - speed["y"]) < 12
