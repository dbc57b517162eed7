"""`report.html` in a real browser: its numbers, its tables, its list and its links."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from urllib.parse import quote

import pytest
from playwright.sync_api import Page
from support import fake_trials
from support.report_page import METHODS, Driven, needs_chromium, open_trial

from kraft.evaluation import evaluate

pytestmark = needs_chromium
NAMED = ("table", "image", "figure", "columnheader", "search")


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


@pytest.mark.parametrize("width", [390, 601, 700, 761, 820, 900, 1241, 1280])
def test_tables_fit_every_window(width: int, tab: Page, driven: Driven) -> None:
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


@pytest.mark.parametrize("width", [360, 390, 560, 600])
def test_the_words_of_the_list_of_trials_are_not_broken_on_a_phone(width: int, tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": width, "height": 844})
    tab.goto(driven.url)
    words = tab.locator(".trials-list td:nth-child(-n+4)").evaluate_all("""all => all.flatMap(cell => {
        const found = [], texts = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
        while (texts.nextNode()) {
            for (const word of texts.currentNode.textContent.matchAll(/\\S+/g)) {
                const range = document.createRange();
                range.setStart(texts.currentNode, word.index);
                range.setEnd(texts.currentNode, word.index + word[0].length);
                found.push([word[0], new Set([...range.getClientRects()].map(box => Math.round(box.top))).size]);
            }
        }
        return found;
    })""")
    assert len(words) > 10
    assert [word for word, lines in words if lines > 1] == []


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


def test_the_picture_of_a_sweep_is_as_dark_as_the_page_and_light_on_paper(
    tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    several = (*METHODS, "replanner-openloop", "cons-replanner-openloop", "conservative-kraft", "mppi", "dwa")
    evaluate(["turns"], several, trials=1, vary={"sensing.noise_scale": [0, 1]}, out=tmp_path / "out")
    tab.emulate_media(color_scheme="dark")
    tab.goto((tmp_path / "out" / "report.html").as_uri())
    parts = tab.locator(".sweep:visible rect, .sweep:visible text, .sweep:visible line, .sweep:visible circle")
    fills, strokes = (
        f"all => all.map(e => getComputedStyle(e).{name}).filter(c => c != 'none')" for name in ("fill", "stroke")
    )
    ground = tab.evaluate("getComputedStyle(document.body).backgroundColor")
    assert parts.evaluate_all(fills)[0] == ground
    light = {"rgb(255, 255, 255)", "rgb(22, 24, 29)", "rgb(102, 112, 128)", "rgb(227, 230, 235)"}
    assert light.isdisjoint(parts.evaluate_all(fills) + parts.evaluate_all(strokes))
    tab.emulate_media(media="print", color_scheme="dark")
    assert parts.evaluate_all(fills)[0] == "rgb(255, 255, 255)"
    assert light <= set(parts.evaluate_all(fills) + parts.evaluate_all(strokes))


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


def test_a_heading_of_the_overview_sorts_the_entries_below_their_totals(
    tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    found = evaluate(["turns", "boxes", "slip"], METHODS, trials=9, out=tmp_path / "out")
    successes = {result.entry: result.success for result in found.summary.results if result.method == "kraft"}
    ascending = sorted(successes, key=lambda entry: successes[entry])
    assert len(set(successes.values())) == 3
    assert ascending != list(successes) != ascending[::-1]
    tab.goto((tmp_path / "out" / "report.html").as_uri())
    rows = tab.locator(".overview tbody tr > th")
    heading = tab.locator(".overview thead button:text-is('KRAFT')")
    heading.click()
    assert rows.all_inner_texts() == ["all entries", *ascending]
    heading.press("Enter")
    assert rows.all_inner_texts() == ["all entries", *ascending[::-1]]
    tab.locator(".overview thead button:text-is('entry')").press("Enter")
    assert rows.all_inner_texts() == ["all entries", *sorted(successes)]


def test_a_number_of_the_overview_is_an_underlined_link_that_takes_the_focus_to_its_trials(
    tab: Page, driven: Driven
) -> None:
    tab.goto(driven.url)
    number = tab.locator(".overview tbody.rows td a").first
    assert number.evaluate("e => getComputedStyle(e).textDecorationLine") == "underline"
    for _ in range(2):  # the second time the address is the same
        tab.evaluate("scrollTo(0, 0)")
        number.press("Enter")
        tab.wait_for_function("() => document.activeElement.closest('#trials')")
        assert tab.evaluate("document.getElementById('trials').getBoundingClientRect().top < innerHeight / 2")
        tab.keyboard.press("Tab")
        assert tab.evaluate("document.activeElement.id") == "filter-outcome"
    assert tab.inner_text("#trials-count") == "2 trials of 4"


@pytest.mark.parametrize(
    ("trials", "said"),
    [(31, ["show the other one"]), (40, ["show all 10 others"]), (365, ["show 300 more of 335", "show all 35 others"])],
)
def test_the_button_below_the_list_says_whether_it_shows_all_others(
    trials: int, said: list[str], tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    evaluate(["turns"], ["kraft"], trials=trials, out=tmp_path / "out")
    tab.goto((tmp_path / "out" / "report.html").as_uri())
    for text in said:
        assert tab.inner_text("#trials-more") == text
        tab.click("#trials-more")
    assert not tab.locator("#trials-more").is_visible()
    assert tab.locator("#trials tbody tr").count() == trials


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


def test_the_axes_of_the_panels_are_side_by_side_whatever_their_words(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    tab.locator(".panels small").first.evaluate("e => { e.textContent = 'words of a long title '.repeat(9); }")
    bottoms = tab.locator(".panels svg").evaluate_all("all => all.map(e => e.getBoundingClientRect().bottom)")
    assert len(bottoms) == 2
    assert bottoms[0] == pytest.approx(bottoms[1], abs=1.0)


def test_a_window_of_1000_pixels_has_three_panels_in_a_row_and_tables_beside_the_floor_plan(
    tab: Page, driven: Driven
) -> None:
    tab.set_viewport_size({"width": 1000, "height": 1400})
    tab.goto(driven.url)
    tab.evaluate("document.querySelector('.panels').append(document.querySelector('.panels figure').cloneNode(true))")
    boxes = "all => all.map(e => e.getBoundingClientRect())"
    panels = tab.locator(".panels figure").evaluate_all(boxes)
    assert len(panels) == 3
    assert len({panel["top"] for panel in panels}) == 1
    assert panels[-1]["right"] > 950
    (plan,), (first, others) = (tab.locator(f".scenario > {of}").evaluate_all(boxes) for of in ("figure", ".tables"))
    assert first["bottom"] < others["top"] == plan["top"]
    assert others["left"] > plan["right"]


def test_the_colours_of_the_legend_of_the_overview_are_those_of_its_cells(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    cell = tab.locator(".overview td.ends").first.evaluate("e => getComputedStyle(e).backgroundImage")
    looks = ("success", "timeout", "collision")
    swatch = "e => getComputedStyle(e).backgroundColor"
    colours = [tab.locator(f"#overview .key .swatch.{look}").evaluate(swatch) for look in looks]
    assert [colour in cell for colour in colours] == [True, True, True]
    assert len(set(colours)) == 3


@pytest.mark.parametrize(("width", "columns"), [(390, 1), (640, 1), (700, 2), (760, 2), (800, 2)])
def test_as_many_panels_are_side_by_side_as_fit(width: int, columns: int, tab: Page, driven: Driven) -> None:
    tab.set_viewport_size({"width": width, "height": 900})
    tab.goto(driven.url)
    tops = tab.locator(".panels figure").evaluate_all("all => all.map(e => e.getBoundingClientRect().top)")
    assert len(set(tops)) == 2 / columns
    assert tab.evaluate("document.documentElement.scrollWidth") <= width


def test_the_names_of_entries_take_no_more_room_than_their_words_beside_narrow_cells(
    tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    many = (*METHODS, "conservative-kraft", "filtered-kraft", "replanner-openloop", "cons-replanner-openloop", "mppi")
    evaluate(["turns", "slip"], many, trials=1, out=tmp_path / "out")
    tab.set_viewport_size({"width": 700, "height": 900})
    tab.goto((tmp_path / "out" / "report.html").as_uri())
    assert tab.locator(".overview.narrow").count() == 1
    widths = tab.locator(".overview tbody th").evaluate_all("all => all.map(e => e.getBoundingClientRect().width)")
    assert max(widths) < 130


@pytest.mark.parametrize("width", [761, 1100, 1400])
def test_a_missing_time_does_not_look_like_the_sign_of_the_chance_beside_it(
    width: int, tab: Page, driven: Driven
) -> None:
    tab.set_viewport_size({"width": width, "height": 900})
    tab.goto(driven.url)
    row = tab.locator(".tables tr", has=tab.locator("th:text-is('OneShot + OpenLoop')")).first
    edges = """e => { const r = document.createRange(); r.selectNodeContents(e.firstChild);
        const box = r.getBoundingClientRect(); return [box.left, box.right]; }"""
    mean, chance = (row.locator("td").nth(k).evaluate(edges) for k in (3, 4))
    assert chance[0] - mean[1] > 9


def test_a_table_that_continues_on_the_next_page_of_paper_has_its_heading_there(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    tab.emulate_media(media="print")
    assert tab.locator(".tables table:not(:has(thead)), .overview:not(:has(thead))").count() == 0
    # Chromium repeats the cells of a heading, but leaves out what is drawn for a button
    displays = tab.locator("thead th > button").evaluate_all("all => all.map(e => getComputedStyle(e).display)")
    assert set(displays) == {"contents"}


def test_a_print_leaves_no_page_half_empty(tab: Page, driven: Driven) -> None:
    tab.goto(driven.url)
    paper = tab.pdf(format="A4", prefer_css_page_size=True)
    assert len(re.findall(rb"/Type\s*/Page\b", paper)) == 2


def test_a_print_of_many_entries_has_their_headings_beside_their_tables(
    tab: Page, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_trials.use(monkeypatch, fake_trials.quick, inline=True)
    methods = (*METHODS, "conservative-kraft", "filtered-kraft", "adaptive-kraft", "mppi", "sst", "dwa", "kraft-mppi")
    evaluate(suite="hard", methods=methods, trials=1, out=tmp_path / "out")
    tab.goto((tmp_path / "out" / "report.html").as_uri())
    paper = tab.pdf(format="A4", prefer_css_page_size=True)
    # two entries of nine methods on a page; with each heading at the end of the page before its table it was one
    assert len(re.findall(rb"/Type\s*/Page\b", paper)) <= 30 // 2 + 8
