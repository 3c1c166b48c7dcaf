"""What the demo shows on the terminal."""

import io
from types import SimpleNamespace

import pytest

from rosproxy.demo.board import Board, Entry
from rosproxy.demo.screen import LineScreen, LiveScreen, frame, summary, table
from rosproxy.demo.tally import Verdict


def entry(node, *, seen="", running=True, **state):
    state = {"publisher": None, "subscription": None, "answered": None} | state
    worker = SimpleNamespace(running=running, state={"registered": True, **state})
    return Entry("inside", node, worker, seen)  # type: ignore[arg-type]


TALKER = {"publisher": {"published": 12, "unheard": 2, "connected": 1}}
LISTENER = {"subscription": {"count": 7, "connected": 0, "problem": "[Errno 111] refused"}}


@pytest.fixture
def board():
    entries = [
        entry("talker", seen="host:45000", uri="http://talker.inside:1/", **TALKER),
        entry("listener", **LISTENER),
        entry("adder", answered=1),
        entry("late", registered=False),
        entry("gone", running=False),
    ]
    made = Board(entries={one.node: one for one in entries})
    made.enter("first act")
    made.tell("it began")
    return made


def rows(board):
    return {row.node: row for row in board.rows()}


def test_each_node_has_a_row_with_what_applies_to_it(board):
    shown = rows(board)
    talker, listener = shown["talker"], shown["listener"]
    assert (talker.own, talker.seen) == ("talker.inside:1", "host:45000")
    assert (talker.sent, talker.received, talker.state) == ("10", "", "connected, 2 unheard")
    assert (listener.sent, listener.received, listener.state) == ("", "7", "refused")
    assert [shown[node].state for node in ("adder", "late", "gone")] == [
        "1 call",
        "waiting for its master",
        "stopped",
    ]


def test_the_rate_is_that_of_the_last_second():
    talker = entry("talker", **TALKER)
    rates = []
    for now in range(4):
        talker.worker.state["publisher"] = {"published": now * 20, "unheard": 0}
        rates.append(talker.rate(float(now)))
    assert rates == ["0/s", "20/s", "20/s", "20/s"]


def test_columns_line_up_and_move_together_on_a_narrow_terminal(board):
    wide, narrow = table(board.rows(), 200), table(board.rows(), 60)
    for lines in (wide, narrow):
        column = lines[0].index("STATE")
        assert lines[1][column:].startswith("connected")
    assert wide[0].index("STATE") > narrow[0].index("STATE")


def test_the_frame_has_phase_table_and_events(board):
    text = "\n".join(line for _, line in frame(board, 120))
    for part in ("first act", "CALLS ITSELF", "talker.inside:1", "it began"):
        assert part in text


def test_the_live_screen_draws_over_its_last_frame(board):
    out = io.StringIO()
    screen = LiveScreen(out)
    screen.draw(board)
    first = out.getvalue()
    screen.draw(board)
    assert not first.startswith("\x1b[1A")
    assert out.getvalue()[len(first) :].startswith(f"\x1b[{first.count(chr(10))}A")


def test_the_line_screen_tells_each_event_once(board):
    out = io.StringIO()
    screen = LineScreen(out)
    screen.draw(board)
    screen.draw(board)
    assert out.getvalue().count("it began") == 1
    assert out.getvalue().count("inside talker: 10 (connected, 2 unheard)") == 2


def test_the_summary_names_what_failed():
    verdicts = [
        Verdict("counts fit", met=True, detail="5"),
        Verdict("fast", met=False, detail="9 s"),
    ]
    text = summary(verdicts, color=False)
    assert "ok      counts fit: 5" in text
    assert "FAILED  fast: 9 s" in text
    assert "1 of 2 expectations met" in text
