"""Shutter button on the handle: each press is an event, upon which the page that aims takes the picture."""

import logging
from math import inf

from device.errors import BusFault
from device.ports import Button
from services.instrument.events import EventBus

log = logging.getLogger(__name__)


class ShutterButton:
    """Publisher of the presses of a head's button; None: a head without one. Not thread-safe: the thread `head` polls.

    The page sends the press, since it knows visit and slot, and holds the control lease.
    """

    def __init__(self, button: Button | None, event_bus: EventBus) -> None:
        self._button, self._event_bus = button, event_bus
        self.pressed_at_s = -inf  # clock time of the last press
        self._since_s: float | None = None
        self._is_silent = False

    @property
    def is_readable(self) -> bool:
        """Whether the head has a button, and the last poll could read it."""
        return self._button is not None and not self._is_silent

    def poll(self) -> None:
        """Publish a press that began since the last poll; one that lies between two polls is missed."""
        if self._button is None:
            return
        try:
            since_s = self._button.pressed_since_s()
        except BusFault as error:  # the page's own button stays
            if not self._is_silent:
                log.warning("the shutter button cannot be read: %s", error, extra={"code": error.code})
            self._is_silent = True
            return
        self._is_silent = False
        if since_s is not None and since_s != self._since_s:
            self._event_bus.publish("button")
            self.pressed_at_s = since_s
        self._since_s = since_s
