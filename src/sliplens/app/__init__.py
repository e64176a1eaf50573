"""Page in a browser: the live readings of a running sensor; needs the extra `live`."""

from sliplens.extras import require_packages

require_packages("websockets", extra="live", purpose="the page")

from sliplens.app.server import LivePage  # noqa: E402 (needs the package)

__all__ = ["LivePage"]
