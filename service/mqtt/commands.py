"""The gate that a command over MQTT has to pass. Pure: the caller provides the time.

A client is known as USER/CLIENT. The user is in the topic, cmd/USER/VERB, where the broker's access list lets everybody
write below the own name only; the client is in the payload, and tells the pages of a user apart. So nobody can renew or
release the lease of another user.

A message that is retained, too large, not a command, late, a repetition or out of order is refused, and counted. A stop
passes even late and out of order, and in a flood of other commands: it can only bring the vehicle to rest. All memory
is bounded, and so is the number of commands a second that pass.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from typing import Any

from pydantic import TypeAdapter, ValidationError

from upright.service.mqtt.topics import ARGUMENTS, Command, User
from upright.telemetry.documents import from_json

LARGEST = 4096
"""Maximum size of a command, bytes."""

OLDEST = 2.0
"""s by which a command's time stamp may differ from the local time, in either direction."""

MOST_A_SECOND = 100
"""Maximum number of commands that are processed in one second."""

MOST_STOPS_A_SECOND = 10
"""Maximum number of stops of a kind, orderly or immediate, in one second: none of them does more than the first."""

MOST_CLIENTS = 64
"""Number of clients whose last commands are kept."""

MOST_KNOWN = 64
"""Number of ids of a client by which repetitions are detected."""

_USER = TypeAdapter(User)

UNORDERED = ("stop",)
"""Verbs that are executed even if they are late."""


@dataclass(frozen=True, slots=True)
class Passed:
    """A command to be executed."""

    verb: str
    client: str
    id: str
    arguments: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Refused:
    """A command that is refused, and why; `client` is empty if there is nobody to answer. `again`: a repetition, which
    gets the first reply again."""

    code: str
    text: str
    client: str = ""
    id: str = ""
    again: bool = False


@dataclass(slots=True)
class _Client:
    latest: float = float("-inf")
    known: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_KNOWN))


class CommandGate:
    """Checks commands for one vehicle. `counts` are the numbers of passed and refused commands, by reason."""

    def __init__(self) -> None:
        self.counts = dict.fromkeys(
            ("passed", "retained", "huge", "malformed", "flood", "stale", "duplicate", "reordered"), 0
        )
        self._clients: OrderedDict[str, _Client] = OrderedDict()
        self._second = 0
        self._in_second: Counter[str] = Counter()

    def judge(self, user: str, verb: str, payload: bytes, *, retained: bool, now: float) -> Passed | Refused:
        """Check `payload` on cmd/`user`/`verb` at `now`, Unix seconds."""
        found = self._judge(user, verb, payload, retained, now)
        self.counts["passed" if isinstance(found, Passed) else found.code] += 1
        return found

    def _judge(self, user: str, verb: str, payload: bytes, retained: bool, now: float) -> Passed | Refused:
        if retained:
            return Refused("retained", "A retained command is not executed: it may be outdated.")
        if len(payload) > LARGEST:
            return Refused("huge", f"A command has at most {LARGEST} bytes.")
        if verb not in UNORDERED and self._count("command", now) > MOST_A_SECOND:
            return Refused("flood", f"More than {MOST_A_SECOND} commands per second.")
        model = ARGUMENTS.get(verb)
        try:
            document = from_json(payload)
            command = Command.model_validate(document)
            sender = f"{_USER.validate_python(user)}/{command.client}"
        except ValueError:
            return Refused("malformed", "Not a command.")
        who = (sender, command.id)
        if model is None:
            return Refused("malformed", f"There is no verb {verb[:40]!r}.", *who)
        try:
            arguments = model.model_validate(command.arguments, strict=True).model_dump()
        except ValidationError as error:
            return Refused("malformed", f"{verb}: {_words(error)}.", *who)
        client = self._client(sender)
        if command.id in client.known:
            return Refused("duplicate", "This command has already been received.", *who, again=True)
        if verb not in UNORDERED:
            if abs(now - command.timestamp) > OLDEST:
                text = f"Its time stamp is {now - command.timestamp:+.1f} s off: it is late, or a clock is wrong."
                return Refused("stale", text, *who)
            if command.timestamp < client.latest:
                return Refused("reordered", "A later command has already been received.", *who)
            client.latest = command.timestamp
        elif self._count(f"{verb} {arguments}", now) > MOST_STOPS_A_SECOND:
            return Refused("flood", f"More than {MOST_STOPS_A_SECOND} stops per second.")
        client.known.append(command.id)
        return Passed(verb, sender, command.id, arguments)

    def _count(self, what: str, now: float) -> int:
        """How many there were of `what` in this second, with this one."""
        if int(now) != self._second:
            self._second = int(now)
            self._in_second.clear()
        self._in_second[what] += 1
        return self._in_second[what]

    def _client(self, name: str) -> _Client:
        client = self._clients.get(name) or _Client()
        self._clients[name] = client
        self._clients.move_to_end(name)
        if len(self._clients) > MOST_CLIENTS:
            self._clients.popitem(last=False)
        return client


def _words(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or 'arguments'}: {first['msg']}"[:200]
