from handover_marl.evaluation.reports.tables import ReportTable
from handover_marl.visualization.web_page import render_page

COMPARISON = {
    "version": "1",
    "sides": [("A", "this")],
    "rates": ReportTable(["%"], []),
    "note": "",
    "replays": ({}, {}),
}


def test_values_are_escaped() -> None:
    made = render_page("comparison.html", title="<script>alert(1)</script> & more", changes=[], **COMPARISON)
    assert "<script" not in made
    assert made.count("&lt;script&gt;alert(1)&lt;/script&gt; &amp; more") == 2
    assert made.startswith("<!doctype html>")
