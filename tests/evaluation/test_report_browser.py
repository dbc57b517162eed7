"""`report.html` in a real browser: its numbers, its replays, its list and its links."""

from __future__ import annotations

import json
import os
import shutil
import threading
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright
from support import fake_trials
from support.replays import unpacked, values_of

from kraft.evaluation import Evaluation, evaluate, evaluator
from kraft.evaluation.journal import REPLAYS, Replays
from kraft.evaluation.replay import packed, series
from kraft.evaluation.report import write_report
from kraft.evaluation.report.server import ReportServer
from kraft_cli.work.run import run_command

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None and "CI" not in os.environ, reason="Chromium is not installed: apt-get install chromium"
)
METHODS = ("kraft", "oneshot-openloop")
NAMED = ("table", "image", "figure", "columnheader", "search")


@dataclass(frozen=True)
class Driven:
    """Results folder of real trials, with what is recorded of them."""

    folder: Path
    evaluation: Evaluation

    @property
    def url(self) -> str:
        return (self.folder / "report.html").as_uri()

    @property
    def summary(self) -> Any:
        return json.loads((self.folder / "summary.json").read_text())

    def drive(self, method: str, seed: int) -> Any:
        return unpacked(Replays(self.folder / REPLAYS).read(("turns", method, seed)).drive)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Driven:
    folder = tmp_path_factory.mktemp("driven") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluator, "Processes", fake_trials.Inline)  # real trials, in this process
        found = evaluate(["turns"], METHODS, trials=2, seed=0, out=folder, command_line=run_command)
    return Driven(folder, found)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def tab(browser: Browser) -> Iterator[Page]:
    """A tab whose console has to stay empty."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(60_000)
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    yield page
    page.close()
    assert said == []


def test_what_a_screen_reader_stops_at_has_a_name(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    nodes = tab.context.new_cdp_session(tab).send("Accessibility.getFullAXTree")["nodes"]
    names = [
        (node["role"]["value"], node.get("name", {}).get("value"))
        for node in nodes
        if not node["ignored"] and node["role"]["value"] in NAMED
    ]
    assert len(names) > 5
    assert [role for role, name in names if not name] == []


@pytest.mark.parametrize("width", [390, 601, 700, 761, 820, 900])
def test_tables_fit_windows_of_tablets(width: int, tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": width, "height": 1000})
    tab.goto(driven.url)
    assert (
        tab.evaluate("[...document.querySelectorAll('.wide')].filter(d => d.scrollWidth > d.clientWidth).length") == 0
    )
    assert tab.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("width", [390, 761, 820, 900, 1000, 1240])
def test_ticks_of_axes_can_be_read_in_every_window(width: int, tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": width, "height": 1000})
    tab.goto(driven.url)
    heights = """all => all.filter(e => e.getBoundingClientRect().width > 0).map(e => {
        const drawing = e.closest('svg');
        return parseFloat(getComputedStyle(e).fontSize) * drawing.clientWidth / drawing.viewBox.baseVal.width;
    })"""
    assert min(tab.locator("main .tick").evaluate_all(heights)) > 9.5


def test_a_count_of_causes_does_not_touch_the_edge_of_its_colour_on_a_phone(tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": 390, "height": 844})
    tab.goto(driven.url)
    padding = tab.locator(".causes .heat").first.evaluate("e => parseFloat(getComputedStyle(e).paddingLeft)")
    assert padding >= 6


@pytest.mark.parametrize(("width", "shown"), [(390, "phone"), (820, "tablet"), (1600, "desk")])
def test_the_picture_of_a_sweep_fits_the_window_and_its_words_can_be_read(
    width: int, shown: str, tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    vary = {"sensing.noise_scale": [0, 1, 2, 3]}
    evaluate(["turns", "slip", "boxes"], METHODS, trials=2, vary=vary, out=tmp_path / "out")
    tab.set_viewport_size({"width": width, "height": 900})
    tab.goto((tmp_path / "out" / "report.html").as_uri())
    assert tab.locator(".sweep:visible").count() == 1
    picture = tab.locator(f".sweep-{shown} .sweep")
    scale = picture.evaluate("e => e.getBoundingClientRect().width / e.viewBox.baseVal.width")
    assert 0.9 < scale <= 1.05
    assert tab.evaluate("document.documentElement.scrollWidth") <= width


def open_trial(tab: Page, url: str, method: str = "kraft", seed: int = 0) -> None:
    tab.goto(f"{url}#trial=turns/{method}/{seed}")
    tab.wait_for_selector("#plots figure")


def car(tab: Page) -> str:
    return tab.get_attribute("#stage .car.body", "d") or ""


def seek(tab: Page, time: float) -> None:
    tab.evaluate("t => { const r = document.getElementById('replay-time'); r.value = t; r.oninput(); }", time)


def shown(tab: Page, plot: str) -> float:
    """Number under the cursor of a plot."""
    text = tab.locator(f"#plots figcaption:has-text('{plot}') .value").first.inner_text()
    return float(text.split()[0])


def test_the_numbers_are_those_of_the_summary(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    rows = tab.locator("#overview tbody.rows tr").all()
    assert [row.locator("a").first.inner_text() for row in rows] == ["turns"]
    results = driven.summary["results"]
    assert rows[0].locator("td b").all_inner_texts() == [str(n) for n in (*(r["success"] for r in results), 2)]
    causes: Counter[str] = Counter()
    for result in results:
        causes.update(result["causes"])
    failures = sum(result["collision"] + result["timeout"] for result in results)
    assert failures == causes.total() > 0
    heading = tab.locator("#causes thead th").all_inner_texts()[1:-1]
    numbers = tab.locator("#causes tbody.totals td").all_inner_texts()
    assert dict(zip(heading, map(int, numbers[:-1]), strict=True)) == dict(causes)
    assert int(numbers[-1]) == failures
    assert tab.locator("#trials-count").inner_text() == "4 trials"


def test_the_sections_are_linked_at_the_top_and_every_drawing_has_a_name(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    places = tab.locator("nav.contents a").evaluate_all("all => all.map(a => a.getAttribute('href').slice(1))")
    assert places == tab.locator("main > section[id]").evaluate_all("all => all.map(e => e.id)")
    assert len(places) >= 4
    tab.click("nav.contents a[href='#trials']")
    tab.wait_for_function("() => document.getElementById('trials').getBoundingClientRect().top < innerHeight / 2")
    nameless = "all => all.filter(e => !e.ariaHidden && !e.ariaLabel).map(e => e.getAttribute('class'))"
    assert tab.locator("svg").evaluate_all(nameless) == []


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
    tab.select_option("#replay-speed", "8")
    tab.click("#replay-play")
    tab.wait_for_function("d => document.querySelector('#stage .car.body').getAttribute('d') !== d", arg=begin)
    assert tab.inner_text("#replay-play") == "pause"
    tab.keyboard.press("Space")
    assert tab.inner_text("#replay-play") == "play"
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
    assert tab.evaluate("location.hash") == ""


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


def test_trials_are_filtered_and_sorted_and_the_filter_is_in_the_address(tab: Page, driven: Driven) -> None:
    outcomes = Counter(row.outcome for row in driven.evaluation.rows)
    tab.goto(driven.url)
    tab.select_option("#filter-outcome", "collision")
    assert tab.locator("#trials tbody tr").count() == outcomes["collision"]
    address = tab.url
    tab.goto("about:blank")
    tab.goto(address)
    assert tab.input_value("#filter-outcome") == "collision"
    assert tab.inner_text("#trials-count") == f"{outcomes['collision']} trials of 4"
    tab.goto(f"{driven.url}#show&method=kraft")
    tab.click("#trials thead button:has-text('time')")
    tab.click("#trials thead button:has-text('time')")
    listed = [float(text) for text in tab.locator("#trials tbody td:nth-child(5)").all_inner_texts()]
    times = sorted((row.t_s or 0.0 for row in driven.evaluation.rows if row.method == "kraft"), reverse=True)
    assert listed == pytest.approx(times, abs=0.006)


@pytest.mark.parametrize("width", [390, 1100])
def test_no_window_hides_a_column_without_saying_so(tab: Page, driven: Driven, width: int) -> None:
    tab.set_viewport_size({"width": width, "height": 800})
    tab.goto(driven.url)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    boxes = tab.evaluate(
        "[...document.querySelectorAll('.wide')].filter(b => b.clientWidth)"
        ".map(b => [b.scrollWidth > b.clientWidth + 2, !b.previousElementSibling.hidden])"
    )
    assert boxes
    assert all(cut == says for cut, says in boxes)
    open_trial(tab, driven.url)
    assert tab.evaluate("document.querySelector('#replay').scrollWidth") <= width


def test_a_window_of_1100_pixels_shows_all_columns_of_two_methods(tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": 1100, "height": 800})
    tab.goto(driven.url)
    tab.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true; })")
    widths = "[...document.querySelectorAll('.wide')].map(b => [b.scrollWidth, b.clientWidth])"
    assert all(needed <= shown + 1 for needed, shown in tab.evaluate(widths))
    ends = tab.locator(".tables td:nth-child(3)").first
    assert ends.locator("small").last.evaluate("e => e.textContent").startswith("paper 27\u00a0/\u00a03")
    heights = "e => e.getBoundingClientRect().height / parseFloat(getComputedStyle(e).lineHeight)"
    assert ends.locator("small").last.evaluate(heights) < 1.5


def test_the_overview_of_many_entries_has_the_whole_settings_of_each(
    tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    evaluate(suite="hard", methods=METHODS, trials=1, out=tmp_path / "few")
    methods = (*METHODS, "conservative-kraft", "filtered-kraft", "adaptive-kraft")
    evaluate(suite="hard", methods=methods, trials=1, out=tmp_path / "more")
    tab.set_viewport_size({"width": 1100, "height": 800})
    tab.goto((tmp_path / "few" / "report.html").as_uri())
    cut = "all => all.filter(e => e.scrollWidth > e.clientWidth || e.scrollHeight > e.clientHeight).length"
    settings = tab.locator(".overview.many th small")
    assert settings.count() == 30
    assert settings.evaluate_all(cut) == 0
    tab.emulate_media(media="print")
    tab.set_viewport_size({"width": 703, "height": 1000})
    tab.goto((tmp_path / "more" / "report.html").as_uri())
    assert settings.count() == 30
    assert settings.evaluate_all(cut) == 0


def test_a_page_of_paper_holds_every_table_and_the_overview_has_its_words(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    tab.emulate_media(media="print")
    for width in (703, 794):  # A4 without and with its margins, at 96 px per inch
        tab.set_viewport_size({"width": width, "height": 1000})
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.locator(".overview td span").first.is_visible()
    sizes = [
        tab.locator(f".overview td {of}").first.evaluate("e => getComputedStyle(e).fontSize") for of in ("b", "span")
    ]
    assert sizes[0] == sizes[1]
    heading = tab.locator(".overview th:not([scope])").nth(1)
    assert heading.evaluate("e => getComputedStyle(e).writingMode") == "horizontal-tb"


def test_a_phone_has_no_table_that_is_cut(tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": 390, "height": 844})
    tab.goto(driven.url)
    cut = "[...document.querySelectorAll('.wide')].filter(b => b.scrollWidth > b.clientWidth + 1).length"
    assert tab.evaluate(cut) == 0
    labels = "e => getComputedStyle(e, '::before').content"
    cell = tab.locator(".totals-table td[data-label='mean time, s']").first
    assert cell.evaluate(labels) == '"mean time, s"'
    drawn = tab.locator(".measures td.drawing").first
    assert drawn.evaluate(labels).startswith('"deviation from the prediction, until ')
    charts = tab.locator("[data-stacked] svg.outcomes").evaluate_all(
        "all => all.map(e => e.getBoundingClientRect().width)"
    )
    assert min(charts) > 340


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


def test_the_legend_names_only_what_the_floor_plan_has(tab: Page, driven: Driven) -> None:
    open_trial(tab, driven.url)
    assert tab.locator("[data-thing]:visible").count() == 0
    assert not tab.locator("input[data-layer=hidden]").is_visible()
    assert [text.split("\n")[-1] for text in tab.locator(".marks li:visible").all_inner_texts()] == [
        "start, with its heading",
        "goal",
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


def test_addresses_may_be_coded_in_any_way_and_a_filter_without_trials_says_so(
    tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    vary = {"sensing.rate_hz": [5, 6], "sensing.latency": [0, 0.1]}
    evaluate(["turns"], METHODS, trials=1, vary=vary, out=tmp_path / "out")
    url, name = (tmp_path / "out" / "report.html").as_uri(), "turns sensing.rate_hz=5, sensing.latency=0"
    for address in (name, quote(name, safe="")):
        tab.goto("about:blank")
        tab.goto(f"{url}#trial={address}/kraft/0")
        assert tab.inner_text("#replay-title") == f"{name}, KRAFT, seed 0"
    for address in ("#100%", "#trial=turns%/kraft/0"):
        tab.goto("about:blank")
        tab.goto(url + address)
        assert tab.locator("#replay").is_visible() == address.startswith("#trial")
    tab.goto("about:blank")
    tab.goto(f"{url}#show&method=nosuch&outcome=success")
    assert tab.inner_text("#trials-alarm") == "No trial here has the method nosuch: the list is not filtered by it."
    assert tab.input_value("#filter-outcome") == "success"
    tab.select_option("#filter-method", "kraft")
    assert not tab.locator("#trials-alarm").is_visible()


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
            long = f"replay/{'9' * 5000}/drive"
            for path, host, status in (
                ("", "evil.example", 403), ("replay/99/drive", None, 404), (long, None, 404), ("../x", None, 404)
            ):  # fmt: skip
                request = urllib.request.Request(server.url + path, headers={"Host": host} if host else {})
                with pytest.raises(HTTPError) as caught:
                    urllib.request.urlopen(request)
                caught.value.close()
                assert caught.value.code == status
        finally:
            server.shutdown()
            thread.join()
