"""An SDO client (CiA 301) that takes only an answer to its own question, and waits as long as the drive needs.

A drive that is busy (after boot-up, or while it stores a mapping) answers late. If the question has been asked again by
then, it answers twice, and the second answer must not count for the next question. So index and subindex of each answer
are compared with those of the question, and the answers still owed are awaited before the next one.
canopen makes and reads the frames.
"""

from __future__ import annotations

import queue
import struct
import time
from collections import Counter
from typing import Any, Protocol

import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.constants import ABORT_TIMED_OUT

ATTEMPTS = 3
"""Times that a question is asked before a node counts as silent: a frame may get lost."""

MARGIN = 1.5
"""Times the last answer's that another one may need."""

UPLOAD, DOWNLOAD, UPLOAD_SEGMENT = 2, 1, 3
"""Client command specifiers; the fourth, 0, is that of a download's segment."""

ANSWERS = {UPLOAD: 2, DOWNLOAD: 3, UPLOAD_SEGMENT: 0, 0: 1}
"""Client to server command specifier."""

ABORTED = 0x80
TOGGLE = 0x10
NO_OBJECT = bytes(3)
"""Index and subindex in the abort of a server that does not know to which transfer it belongs."""


class Clock(Protocol):
    """The time of a set-up: that of the wall, or of a simulation."""

    def now(self) -> float:
        """s."""
        ...

    def sleep(self, seconds: float) -> None: ...

    def answer(self, answers: queue.SimpleQueue[bytes], seconds: float) -> bytes | None:
        """The next of `answers`, awaited for `seconds` at most; None if there is none."""
        ...


class WallClock:
    """The time of this computer."""

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def answer(self, answers: queue.SimpleQueue[bytes], seconds: float) -> bytes | None:
        try:
            return answers.get(timeout=max(0.0, seconds))
        except queue.Empty:
            return None


WALL = WallClock()


class PatientClient(SdoClient):
    """The SDO client for one node. `strays` are the answers since the last question that belonged to none.

    `timeout` is in s, from a question to its answer.
    """

    def __init__(self, network: canopen.Network, node: int, timeout: float, clock: Clock = WALL) -> None:
        dictionary = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        super().__init__(0x600 + node, 0x580 + node, dictionary)  # type: ignore[no-untyped-call]
        self.network: Any = network
        self.strays: list[bytes] = []
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._timeout = timeout
        self._clock = clock
        self._owed: Counter[bytes] = Counter()
        """Answers that may still come, by what they answer."""
        self._transfer = NO_OBJECT
        self._needed = 0.0
        """s that the last answer needed, from the first time that its question was asked."""
        network.subscribe(self.tx_cobid, self.on_response)

    def close(self) -> None:
        """Hear no more answers."""
        self.network.unsubscribe(self.tx_cobid, self.on_response)

    def on_response(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Called by canopen for each answer, from any thread."""
        self._answers.put(bytes(data))

    def request_response(self, sdo_request: bytes) -> bytes:
        """Ask, and wait for the answer. Called by canopen.

        Raises canopen's SdoAbortedError, or SdoCommunicationError if there is no answer.
        """
        self._settle()
        request = bytes(sdo_request)
        if request[0] >> 5 in (UPLOAD, DOWNLOAD):
            self._transfer = request[1:4]
        question = self._question(request)
        begin = self._clock.now()
        self.strays = []
        for _ in range(ATTEMPTS):
            self.send_request(request)  # type: ignore[no-untyped-call]
            self._owed[question] += 1
            deadline = self._clock.now() + self._timeout
            while (answer := self._receive(deadline)) is not None:
                if _answers(question, answer):
                    self._needed = self._clock.now() - begin
                    if answer[0] == ABORTED:
                        raise canopen.SdoAbortedError(struct.unpack_from("<L", answer, 4)[0])
                    return answer
                self.strays.append(answer)
        self.abort(ABORT_TIMED_OUT)  # type: ignore[no-untyped-call]
        raise canopen.SdoCommunicationError("No SDO response received")

    def _question(self, request: bytes) -> bytes:
        """What is asked: the command specifier, the toggle bit of a segment, and the object."""
        kind = request[0] >> 5
        toggle = request[0] & TOGGLE if kind in (UPLOAD_SEGMENT, 0) else 0
        return bytes((kind, toggle)) + self._transfer

    def _settle(self) -> None:
        """Wait for the answers still owed. Each takes no longer than the first one did, counted from its question."""
        while self._owed.total():
            if self._receive(self._clock.now() + MARGIN * self._needed) is None:
                break  # it got lost
        self._owed.clear()

    def _receive(self, deadline: float) -> bytes | None:
        """The next answer, which is then no longer owed; None after the deadline."""
        left = deadline - self._clock.now()
        answer = self._clock.answer(self._answers, left) if left > 0.0 else None
        if answer is not None:
            question = next((each for each, count in self._owed.items() if count and _answers(each, answer)), None)
            if question is not None:
                self._owed[question] -= 1
        return answer


def _answers(question: bytes, answer: bytes) -> bool:
    """Whether an answer belongs to a question, see `PatientClient._question`."""
    if len(answer) != 8:
        return False
    kind, toggle, transfer = question[0], question[1], question[2:]
    if answer[0] == ABORTED:
        return answer[1:4] in (transfer, NO_OBJECT)
    if answer[0] >> 5 != ANSWERS[kind]:
        return False
    return answer[1:4] == transfer if kind in (UPLOAD, DOWNLOAD) else answer[0] & TOGGLE == toggle
