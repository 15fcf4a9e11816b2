"""A line that loses, damages, doubles and delays what an instrument answers."""

import math

from sim_devices.wire import WireServer

KINDS = ("drop", "corrupt", "double", "delay")


class FaultyLine(WireServer):
    """Passes requests on, and spoils a share of the answers, each in one of several ways.

    Parameters
    ----------
    kinds : sequence of str
        Ways among `KINDS`, and "cut" for an answer that ends too early.
    share : float
        Share of the answers that are spoilt, 0 to 1.
    latest : float
        Longest delay of an answer, s.
    overtaking : bool
        Whether an answer may come before one that was given earlier.
    corrupted : callable, optional
        Damages an answer, with a generator of random numbers; by default one bit is wrong.

    Attributes
    ----------
    spoilt, repeats : int
        How many answers were spoilt, and how many requests were those of before once more.
    """

    def __init__(self, server, clock, rng, *, kinds=KINDS, share=0.5, latest=0.5, overtaking=False, corrupted=None):
        self.server = server
        self.clock = clock
        self.rng = rng
        self.kinds = kinds
        self.share = share
        self.latest = latest
        self.overtaking = overtaking
        self.spoilt = self.repeats = 0
        self._corrupted = corrupted or server.corrupted
        self._due = []
        self._last = b""

    def receive(self, data):
        self.repeats += data == self._last
        self._last = data
        answer = self.server.receive(data)
        now = self.clock.now()
        if not answer:
            return b""
        delay = 0.0
        if self.rng.random() < self.share:
            self.spoilt += 1
            kind = self.rng.choice(self.kinds)
            if kind == "drop":
                answer = b""
            elif kind == "corrupt":
                answer = self._corrupted(answer, self.rng)
            elif kind == "cut":
                answer = answer[: self.rng.integers(len(answer))]
            elif kind == "double":
                self._put(now + self.rng.random() * self.latest, answer)
            else:
                delay = self.rng.random() * self.latest
        if not self._due and not delay:
            return answer
        self._put(now + delay, answer)
        return self._ripe()

    def _put(self, instant, answer):
        if self._due and not self.overtaking:
            instant = max(instant, self._due[-1][0])
        self._due.append((instant, answer))
        self._due.sort(key=lambda each: each[0])

    def _ripe(self):
        sent = b""
        while self._due and self._due[0][0] <= self.clock.now():
            sent += self._due.pop(0)[1]
        return sent

    def unsolicited(self):
        return self._ripe() + self.server.unsolicited()

    def next_unsolicited(self):
        return min([self.server.next_unsolicited(), *(instant for instant, _ in self._due[:1])])


def lost(answer):
    return b""


def damaged(answer):
    """Return an answer with a wrong bit in its middle."""
    middle = len(answer) // 2
    return answer[:middle] + bytes((answer[middle] ^ 1,)) + answer[middle + 1 :]


def halved(answer):
    """Return the first half of a line."""
    return answer[: len(answer) // 2] + b"\r"


def spoil_next_answer(server, spoilt):
    """Have the next answer of a server, and none after it, be what `spoilt` makes of it."""
    waiting = vars(server).setdefault("spoilt", [])
    waiting.append(spoilt)

    def receive(data):
        sent = type(server).receive(server, data)
        begin = server.answer_begins(sent)
        return sent[:begin] + waiting.pop(0)(sent[begin:]) if waiting and sent[begin:] else sent

    server.receive = receive


class InPieces(WireServer):
    """Passes requests on; each answer comes in two pieces with a pause between them.

    Parameters
    ----------
    place : int
        Where an answer is cut, bytes from its beginning.
    pause : float
        Time between the pieces, s.
    """

    def __init__(self, server, clock, place, pause):
        self.server, self.clock = server, clock
        self.place, self.pause = place, pause
        self._rest, self._due = b"", math.inf

    def receive(self, data):
        answer = self.server.receive(data)
        if self.place >= len(answer):
            return answer
        self._rest, self._due = answer[self.place :], self.clock.now() + self.pause
        return answer[: self.place]

    def unsolicited(self):
        if self.clock.now() < self._due:
            return b""
        sent, self._rest, self._due = self._rest, b"", math.inf
        return sent

    def next_unsolicited(self):
        return self._due
