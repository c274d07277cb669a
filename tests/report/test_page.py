"""Values as the report shows them."""

from eddies.report.page import Metric, RunRecord, Section, render_page


def test_what_is_not_finite_within_a_metric_is_shown_as_not_available():
    row = Metric("skewness", "skewness", {"this run": float("nan"), "literature": -0.5})
    assert row.value == {"this run": None, "literature": -0.5}
    record = RunRecord("run", "title", "", [("product",)])
    page = render_page(record, [Section("stationary", "Stationary turbulence", metrics=[row])])
    assert "<td>not available</td><td>-0.5</td>" in page


def test_a_folded_section_shows_its_main_numbers_and_opens_without_a_script():
    kernel = Section("kernel", "Kernel", "All.", metrics=[Metric("error", "its error", 0.25)], main=("error",),
                     folded=True)
    page = render_page(RunRecord("run", "the title of its scene", "", [("product",)]), [kernel])
    summary = page[page.index("<details><summary>"):page.index("</summary>")]
    assert "Kernel" in summary and "0.25" in summary and "its error" in summary and "All." not in summary
    assert '<a href="#kernel">' in page and "<details open>" not in page and "<script" not in page
    assert page.index("the title of its scene") < page.index("<nav>")
