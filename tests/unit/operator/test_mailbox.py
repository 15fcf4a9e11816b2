"""Letters between a run and a panel: each arrives as it was written, and whatever else is in its place is none."""

import json

import pytest

from bench.base import Interrupts
from bench.operator import PanelMailbox, Question, RunMailbox

ASKED = Question("hang a load", ("resume", "abort"), "PROMPT", {"rate": "3 K/s"}, "not a number")


@pytest.fixture
def boxes(tmp_path):
    """Both sides, with a question that is asked and answered."""
    run, panel = RunMailbox(tmp_path, Interrupts(lambda *_: None)), PanelMailbox(tmp_path)
    (tmp_path / "operator").mkdir()
    run.publish(ASKED)
    panel.reply(1, "resume")
    return run, panel, tmp_path / "operator"


def test_letters_arrive(boxes):
    run, panel, _ = boxes
    assert panel.question() == (1, ASKED)
    assert run.answer() == "resume"


@pytest.mark.parametrize(
    "content",
    [
        "", "{", "[]", "null", "[" * 100_000, '{"answer": true}', '{"answer": null}', '{"answer": ["resume"]}',
        '{"answer": 1}', "{}", '{"answer": "resume", "more": 1}', '{"answer": "abort", "answer": "resume"}',
    ],
)  # fmt: skip
def test_what_is_no_answer_is_none(boxes, content):
    run, _, folder = boxes
    (folder / "answer-1.json").write_text(content)
    assert run.answer() is None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("number", "1"), ("number", [1]), ("number", True), ("text", None), ("title", ["x"]), ("commands", "resume"),
        ("commands", [1]), ("parameters", [1]), ("problem", 1.5), ("more", 1), ("commands", None),
    ],
)  # fmt: skip
def test_what_is_no_question_is_none(boxes, key, value):
    _, panel, folder = boxes
    content = json.loads((folder / "question.json").read_text())
    (folder / "question.json").write_text(json.dumps({**content, key: value}))
    assert panel.question() is None
    del content["text"]
    (folder / "question.json").write_text(json.dumps(content))
    assert panel.question() is None
