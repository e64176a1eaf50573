"""What somebody may have named a thing so that a page, a terminal or a figure does more than show it."""

from typing import Any

FILE_NAME = "<img src=x onerror=hit()>"
ATTACK = f"</p></script>-->{FILE_NAME}<script>hit()</script>&lt;'\"`${{hit()}}{{{{ 7*7 }}}}$\\frac{{x}}[red]\x1b[2J"
_COUNTED = "window.hits = 0; window.hit = () => (window.hits += 1);"
_INJECTED = (
    f"document.body.insertAdjacentHTML('beforeend', '{FILE_NAME}');"
    "const script = document.createElement('script'); script.textContent = 'hit()'; document.body.append(script);"
)


def watch(window: Any) -> None:
    """Count what runs that should not, from the next page on."""
    window.add_init_script(_COUNTED)


def assert_inert(window: Any) -> None:
    """Check that names did nothing but stand there, and that the page would have stopped what they wanted."""
    assert FILE_NAME in window.evaluate("document.body.textContent")
    assert window.evaluate("document.querySelectorAll('img[src=x], [onerror], [onload], [onclick]').length") == 0
    assert window.evaluate("window.hits") == 0
    window.evaluate(_INJECTED)
    window.wait_for_timeout(100)
    assert window.evaluate("window.hits") == 0
