"""The order of a source's episodes: which one comes next, and what must be there before it begins."""

from __future__ import annotations

from collections.abc import Iterable

from saccade.shared.bus.messages import Message, Status
from saccade.shared.bus.wire import MessageError
from saccade.shared.errors import told

READY_STATES = ("ready", "busy")
RECORDER, NOT_RECORDING = "recorder", "not recording"
ENDED = (NOT_RECORDING, "stopped", "failed")  # of a recorder: no log is waited for any more


class Episodes:
    """Knows which episode a source begins next.

    The first one begins when every service in `wait_for` (`awaited`) is ready. If the episodes are `closed` by others,
    each later one begins when the one before it is closed, and recorded if a recorder is waited for. So nothing is lost
    with a service that is killed: the others repeat the episode that they are in, and all before it is in the log. The
    episodes of a source that is `timed` cannot be repeated. A service that is no source has none, and waits for nobody.
    """

    def __init__(self, count: int, run: str, wait_for: Iterable[str] = (), *, closed: bool, timed: bool) -> None:
        self.awaited = set(wait_for)
        self._count, self._end, self._next, self._over = count, count, 0, -1
        self._run, self._closed, self._past = run, closed, int(timed)
        self._recorder = RECORDER in self.awaited and closed
        self._recorded = -1  # the last episode of which the recorder said that all is in the log

    @property
    def may_begin(self) -> bool:
        """Whether everything is there for the next episode."""
        return (not self.awaited and (not self._closed or self._over >= self._next - 1)
                and (not self._recorder or self._recorded >= self._next - 1))

    @property
    def current(self) -> int:
        """The episode that was begun last; -1 before the first."""
        return self._next - 1

    def begin(self) -> int | None:
        """Returns the number of the next episode, which begins now. None if there is none left."""
        if self._next >= self._end:
            return None
        self._next += 1
        return self._next - 1

    def close(self, message: Message) -> None:
        """Takes a message that closes an episode. Raises MessageError if it is of another run, or of an episode that
        has not begun."""
        require_run(message, self._run)
        if self.awaited:
            return  # this source was started again: it asks for this message once it has begun
        if message.episode >= self._next:
            raise MessageError(f"episode: {message.episode} is closed, and {self.current} goes on")
        self._over = max(self._over, message.episode)

    def heard(self, part: str | None, status: Status) -> bool:
        """Takes a status. Returns whether it was the last one that was awaited, or lets the next episode begin."""
        waited = not self.may_begin
        if part == RECORDER and status.state in ENDED:
            self._recorder = False
        elif part == RECORDER and status.run == self._run:
            self._recorded = max(self._recorded, status.episode - 1)
        if not self.awaited:
            return waited and self.may_begin
        if part not in self.awaited or status.state not in READY_STATES:
            return False
        self.awaited.discard(part)
        if status.run == self._run:  # this source was started again: the others are in that episode already
            in_it = status.episode + self._past if self._past else min(status.episode, self._count - 1)
            self._next = max(self._next, in_it)
            self._over = self._next - 1
            self._end = self._count + self._past * self._next
        return not self.awaited


def require_run(message: Message, run: str) -> None:
    """Raises MessageError if a message is of another run."""
    if message.run != run:
        raise MessageError(f"run: {told(message.run)}, not this run {told(run)}")


def stranger(status: Status, part: str | None, run: str) -> str | None:
    """Says why the status under the key of `part` is not one of this run. Returns None if it may be. A service has no
    run before its first episode."""
    if status.run not in ("", run):
        return f"it is of the run {told(status.run)}, not of {told(run)}"
    if status.service != part:
        return f"it is of the service {told(status.service)}, not of {told(part)}"
    return None
