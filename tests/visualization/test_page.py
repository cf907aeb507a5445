import pytest
from jinja2 import UndefinedError

from handover_marl.evaluation.reports.tables import ReportTable
from handover_marl.visualization.web_page import render_page
from tests.visualization.outside import dangling, outside

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


def test_nothing_may_be_left_out() -> None:
    with pytest.raises(UndefinedError):
        render_page("comparison.html", title="some", **COMPARISON)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('<img src="https://example.org/x.png">', ["https://example.org/x.png"]),
        ('<script src="//example.org/x.js"></script>', ["//example.org/x.js"]),
        ("<style>@import 'http://example.org/a.css'; p { background: url(/b.png) }</style>", None),
        ('<iframe srcdoc="&lt;link href=&quot;http://example.org&quot;&gt;"></iframe>', ["http://example.org"]),
        ('<a href="#here">a</a> <a href="episodes/009.html">b</a> <link href="data:,">', []),
    ],
)
def test_outside_references_are_found(text: str, found: list[str] | None) -> None:
    assert outside(text) == (["http://example.org/a.css", "/b.png"] if found is None else found)


def test_dangling_links_are_found() -> None:
    assert dangling('<a href="#here">a</a> <a href="#there">b</a> <p id="here">') == ["#there"]
