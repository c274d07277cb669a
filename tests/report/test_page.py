"""The page and metrics.json: escaped text, values, missing values."""

import json

from eddies.report.page import Section, render_page, strict

RUN = {"name": "run", "title": "the title of its scene", "scene": "a <b> & c", "warnings": []}


def test_a_value_that_is_not_finite_is_missing_on_the_page_and_null_in_the_file():
    first = Section("cost", "Cost")
    stationary = Section("stationary", "Stationary", columns={
        "this run": {"skewness": float("nan")}, "literature": {"skewness": -0.5, "flatness": 3.0}})
    model = Section("model", "Model", numbers={"error": float("inf"), "terms": 3}, labels={"error": "its error"},
                    reasons={"error": "too few frames", "terms": "never"})
    assert stationary.table == [["", "this run", "literature"], ["skewness", "not available", "-0.5"],
                                ["flatness", "", "3"]]
    assert model.table == [["", ""], ["its error", "not available: too few frames"], ["terms", "3"]]
    page = render_page([first, stationary, model], **RUN)
    assert "<td>not available</td><td>-0.5</td>" in page and "not available: too few frames" in page
    assert json.dumps(strict({"a": [float("nan"), {"b": float("inf")}], "c": 1.5}), allow_nan=False) == (
        '{"a": [null, {"b": null}], "c": 1.5}')


def test_text_is_escaped():
    section = Section("model", "A & B", "x < y", notices=["<script>"], numbers={"1 < 2": "<b>"})
    page = render_page([section], **RUN)
    for text in ("a &lt;b&gt; &amp; c", "A &amp; B", "x &lt; y", "&lt;script&gt;", "1 &lt; 2", "&lt;b&gt;"):
        assert text in page


def test_figures_stand_in_the_page_and_one_that_was_not_drawn_is_left_out():
    section = Section("model", "Model")
    section.add_figure("drawn", "A figure", None, "Its caption")
    section.add_figure("failed", "Another", None, "Its own")
    # The width of a PNG file, in bytes 16 to 19, is given at 96 of 150 dots per inch.
    section.illustrations[0].png = b"\x89PNG\r\n\x1a\n" + bytes(8) + (300).to_bytes(4, "big")
    page = render_page([section], **RUN)
    assert 'width="192" src="data:image/png;base64,iVBORw0KGgo' in page and "Its caption" in page
    assert "Another" not in page


def test_only_the_first_section_is_open_and_others_open_without_a_script():
    kernel = Section("kernel", "Kernel", "All.", numbers={"its error": 0.25})
    page = render_page([Section("summary", "Summary"), kernel], **RUN)
    summary = page[page.index("<details><summary><h2>Kernel"):]
    assert "0.25" not in summary[:summary.index("</summary>")] and "0.25" in summary
    assert '<a href="#kernel">' in page and page.count("<details open>") == 1 and "<script" not in page
    assert page.index("the title of its scene") < page.index("<nav>")
