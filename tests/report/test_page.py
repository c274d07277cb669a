"""The page and metrics.json: escaped text, values, missing values."""

import json

from eddies.report.page import Metric, RunRecord, Section, render_page, side_by_side, strict

RUN = RunRecord("run", "the title of its scene", "a <b> & c", [("stage",), ("dns",)])


def test_a_value_that_is_not_finite_is_missing_on_the_page_and_null_in_the_file():
    sections = [Section("stationary", "Stationary", metrics=[
        Metric("skewness", "skewness", {"this run": float("nan"), "literature": -0.5})]),
        Section("model", "Model", metrics=[Metric("error", "its error", float("inf"), "too few frames"),
                                           Metric("terms", "terms", 3)])]
    page = render_page(RUN, sections)
    assert "<td>not available</td><td>-0.5</td>" in page and "not available: too few frames" in page
    assert sections[1].numbers == {"error": None, "terms": 3}
    assert json.dumps(strict({"a": [float("nan"), {"b": float("inf")}], "c": 1.5}), allow_nan=False) == (
        '{"a": [null, {"b": null}], "c": 1.5}')


def test_metrics_of_several_variants_are_rows_with_a_column_for_each():
    rows = side_by_side({"one": [Metric("a", "its a", 1.0), Metric("b", "its b", None, "no frames")],
                         "other": [Metric("a", "its a", {"x": 2.0}), Metric("c", "its c", True)]})
    assert [(row.label, row.value) for row in rows] == [
        ("its a", {"one": 1.0, "other": "x 2"}), ("its b", {"one": "not available: no frames"}),
        ("its c", {"other": True})]


def test_text_is_escaped():
    section = Section("model", "A & B", "x < y", notices=["<script>"], metrics=[Metric("unit", "1 < 2", "<b>")])
    page = render_page(RUN, [section])
    for text in ("a &lt;b&gt; &amp; c", "A &amp; B", "x &lt; y", "&lt;script&gt;", "1 &lt; 2", "&lt;b&gt;"):
        assert text in page


def test_figures_stand_in_the_page_and_one_that_was_not_drawn_is_left_out():
    section = Section("model", "Model")
    section.add_figure("drawn", "A figure", None, "Its caption")
    section.add_figure("failed", "Another", None, "Its own")
    # The width of a PNG file, in bytes 16 to 19, is given at 96 of 150 dots per inch.
    section.illustrations[0].png = b"\x89PNG\r\n\x1a\n" + bytes(8) + (300).to_bytes(4, "big")
    page = render_page(RUN, [section])
    assert 'width="192" src="data:image/png;base64,iVBORw0KGgo' in page and "Its caption" in page
    assert "Another" not in page


def test_a_folded_section_shows_its_title_and_opens_without_a_script():
    kernel = Section("kernel", "Kernel", "All.", metrics=[Metric("error", "its error", 0.25)], folded=True)
    page = render_page(RUN, [kernel])
    summary = page[page.index("<details><summary>"):page.index("</summary>")]
    assert "Kernel" in summary and "0.25" not in summary and "0.25" in page
    assert '<a href="#kernel">' in page and "<details open>" not in page and "<script" not in page
    assert page.index("the title of its scene") < page.index("<nav>")
