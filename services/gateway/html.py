"""How pages are made of their templates. What others said goes into them as text."""

import time
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from jinja2 import Environment, PackageLoader, select_autoescape

from services.gateway.keys import Role, User

_templates = Environment(
    loader=PackageLoader("services.gateway"),
    autoescape=select_autoescape(),
    trim_blocks=True,
    lstrip_blocks=True,
)
_templates.filters["when"] = lambda at: time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(at))


def page(
    name: str, request: Request, user: User | None, status: int = 200, /, **told: Any
) -> Response:
    """A page of a template.

    Args:
      name: of the template.
      request: that it answers.
      user: who asks; None where nobody has come in.
      status: of the answer.
      told: what the template shows.
    """
    may = user is not None and user.role >= Role.OPERATOR
    text = _templates.get_template(name).render(user=user, may=may, path=request.url.path, **told)
    return HTMLResponse(text, status)


def login() -> Response:
    """The way in."""
    return RedirectResponse("/login", 303)


def part(request: Request, whole: str, live: str) -> str:
    """The template that a path wants: the part that changes where it ends so, else the whole."""
    return live if request.url.path.endswith("/live") else whole
