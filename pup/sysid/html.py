"""HTML of self-contained reports: markup escaped by construction, figures inside the page."""

import base64
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_VOID = frozenset(("img", "meta"))

STYLE = """
:root { color-scheme: light; --ink: #1b1f24; --soft: #57606a; --line: #d0d7de; --pale: #f6f8fa; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink); font: 16px/1.5 system-ui, -apple-system,
  "Segoe UI", Roboto, "Helvetica Neue", Arial, "DejaVu Sans", sans-serif; }
main { max-width: 58rem; margin: 0 auto; padding: 1.25rem 1rem 3rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0.5rem 0; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 0.5rem; padding-top: 0.75rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.5rem 0 0.25rem; overflow-wrap: anywhere; }
p, ul { max-width: 44rem; margin: 0.5rem 0; overflow-wrap: anywhere; }
ul { padding-left: 1.25rem; }
nav { font-size: 0.9rem; margin: 1.25rem 0 0; }
nav ul { display: flex; flex-wrap: wrap; gap: 0.25rem 1rem; list-style: none; padding: 0; }
a { color: #0550ae; }
.lead { font-size: 1.1rem; color: var(--soft); }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(13rem, 1fr));
  gap: 0.75rem; margin: 1.25rem 0; }
.facts div { border: 1px solid var(--line); border-radius: 6px; padding: 0.6rem 0.8rem; }
.facts dt { font-size: 0.85rem; color: var(--soft); }
.facts dd { margin: 0; font-size: 1.3rem; font-weight: 600; line-height: 1.3; }
.facts dd small { display: block; font-size: 0.85rem; font-weight: 400; overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: 0.75rem 0; }
table { border-collapse: collapse; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); padding: 0 0 0.35rem; }
caption span { display: inline-block; position: sticky; left: 0;
  max-width: min(44rem, calc(100vw - 2rem)); }
th, td { text-align: left; vertical-align: top; padding: 0.25rem 1rem 0.25rem 0;
  border-bottom: 1px solid var(--line); }
thead th { vertical-align: bottom; font-weight: 600; border-bottom: 1px solid var(--soft); }
tbody th { font-weight: 500; }
td:first-child, th:first-child { padding-left: 0.35rem; }
td.number, th.number { text-align: right; white-space: nowrap; }
.words { white-space: nowrap; }
td.long, th.long { overflow-wrap: anywhere; min-width: 8rem; }
tr.unknown > * { color: #57606a; background: #eceff2; font-style: italic; }
figure { margin: 1rem 0; }
figcaption { font-size: 0.875rem; color: var(--soft); max-width: 44rem; overflow-wrap: anywhere; }
figcaption span { display: block; }
img { display: block; width: min(100%, 34rem); height: auto; }
.panels { display: grid; gap: 0.75rem 1rem; margin: 0.5rem 0 1.25rem;
  grid-template-columns: repeat(auto-fill, minmax(min(15rem, 100%), 1fr)); }
.panels figure { margin: 0; }
.panels img { width: 100%; }
.key { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: 0.25rem 1.25rem;
  font-size: 0.875rem; }
.key span { display: inline-block; width: 1.75rem; margin-right: 0.4rem; vertical-align: middle;
  border-top: 3px solid; }
@media (max-width: 40rem) {
  body { font-size: 15px; }
  table { font-size: 0.8rem; }
  th, td { padding-right: 0.5rem; }
  .status { white-space: nowrap; }
}
@media print {
  body { font-size: 10pt; }
  main { max-width: none; padding: 0; }
  nav { display: none; }
  h2, h3, caption, thead { break-after: avoid; }
  img { width: min(100%, 11cm); }
  figure, tr, .facts div { break-inside: avoid; }
  .wide { overflow: visible; }
  .panels { grid-template-columns: repeat(3, 1fr); }
  table { font-size: 8.5pt; }
  tr.unknown > *, .key span { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""


class Html(str):
    """Markup, as opposed to text that has to be escaped."""

    __slots__ = ()


@dataclass(frozen=True)
class Drawing:
    """A figure as SVG.

    Attributes:
      svg: the file.
      width: in CSS pixels.
      height: in CSS pixels.
    """

    svg: bytes
    width: int
    height: int


def text(value: str) -> Html:
    """Escape text; what cannot be printed (control and direction characters) becomes a blank."""
    if isinstance(value, Html):
        return value
    return Html(html.escape("".join(c if c.isprintable() else " " for c in value)))


def tag(name: str, *children: str, **attributes: str) -> Html:
    """An element; children and attributes that are not `Html` are escaped.

    Args:
      name: such as `p`.
      children: text or markup.
      attributes: `class_` gives `class`, `aria_label` gives `aria-label`.
    """
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{text(value)}"' for key, value in attributes.items()
    )
    if name in _VOID:
        return Html(f"<{name}{given}>")
    return Html(f"<{name}{given}>{join(children)}</{name}>")


def join(parts: Iterable[str]) -> Html:
    """Text and markup behind one another."""
    return Html("".join(text(part) for part in parts))


def figure(drawing: Drawing, alt: str, caption: str = "") -> Html:
    """A figure with the text that stands for it where it cannot be seen."""
    source = "data:image/svg+xml;base64," + base64.b64encode(drawing.svg).decode()
    image = tag("img", src=source, alt=alt, width=str(drawing.width), height=str(drawing.height))
    return tag("figure", image, *([tag("figcaption", caption)] if caption else []))


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
      title: its heading.
      kind: CSS class of its cells: `number`, `long`, `words`, `status` or nothing.
    """

    title: str
    kind: str = ""


def table(
    caption: str,
    columns: Sequence[Column],
    rows: Sequence[Sequence[str]],
    classes: Sequence[str] = (),
) -> Html:
    """A table whose first column names the rows; it scrolls by itself where it is too wide.

    Args:
      caption: what it shows.
      columns: its columns.
      rows: cells, text or markup.
      classes: CSS class per row; none when empty.
    """
    head = [tag("th", c.title, scope="col", **_class(c.kind)) for c in columns]
    body = []
    for row, kind in zip(rows, classes or [""] * len(rows), strict=True):
        cells = [
            tag("td", cell, **_class(c.kind)) for cell, c in zip(row[1:], columns[1:], strict=True)
        ]
        cells.insert(0, tag("th", row[0], scope="row", **_class(columns[0].kind)))
        body.append(tag("tr", *cells, **_class(kind)))
    content = tag(
        "table",
        tag("caption", tag("span", caption)),
        tag("thead", tag("tr", *head)),
        tag("tbody", *body),
    )
    return tag("div", content, class_="wide", role="region", aria_label=caption, tabindex="0")


def _class(kind: str) -> dict[str, str]:
    return {"class_": kind} if kind else {}


def page(title: str, *content: str) -> str:
    """A whole document that loads nothing and runs nothing."""
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name_="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("title", title),
        tag("style", Html(STYLE)),
    )
    body = tag("body", tag("main", *content))
    return f'<!doctype html>\n<html lang="en">{head}{body}</html>\n'
