"""Values as the report shows them."""

from eddies.report.page import Metric, RunRecord, Section, render_page


def test_what_is_not_finite_within_a_metric_is_shown_as_not_available():
    row = Metric("skewness", "skewness", {"this run": float("nan"), "literature": -0.5})
    assert row.value == {"this run": None, "literature": -0.5}
    record = RunRecord("run", "title", "", [("product",)])
    page = render_page(record, [Section("stationary", "Stationary turbulence", metrics=[row])])
    assert "<td>not available</td><td>-0.5</td>" in page
