"""What a language model says gets into a bank through the lint alone, whatever else the endpoint does."""

import json
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml
from faults import served

from pipeline import __main__ as command_line
from pipeline.axes.language import load_bank
from pipeline.axes.language_lint import CLASSES, Component, lint, normalise
from pipeline.errors import PipelineError
from pipeline.libero.tasks import find_task
from pipeline.rewriting import language_model, rewrite
from pipeline.rewriting.language_model import LanguageModel

STOVE = find_task("libero_goal", "turn_on_the_stove")
SENTENCES = tuple(
    f"{please} {verb} the stove {ending}"
    for please in ("please", "kindly", "now", "at last", "do")
    for verb in ("switch on", "heat up", "start", "fire up")
    for ending in ("up here", "over there", "at once", "for the soup")
)

Reply = Callable[[BaseHTTPRequestHandler], None]


def status(code: int, body: bytes = b"", **headers: str) -> Reply:
    def send(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(code)
        for name, value in headers.items():
            handler.send_header(name.replace("_", "-"), value)
        handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        handler.wfile.write(body)

    return send


def says(content: object) -> Reply:
    return status(200, json.dumps({"choices": [{"message": {"role": "assistant", "content": content}}]}).encode())


SHORT_S = 1.5
"""Time limit for an answer in the test of servers that give none."""


def hangs(handler: BaseHTTPRequestHandler) -> None:
    time.sleep(2 * SHORT_S)


def trickles(handler: BaseHTTPRequestHandler) -> None:
    """Each piece in time, the whole never."""
    handler.send_response(200)
    handler.send_header("Content-Length", "1000")
    handler.end_headers()
    for _ in range(20):
        handler.wfile.write(b" ")
        time.sleep(SHORT_S / 10)


def hangs_up(handler: BaseHTTPRequestHandler) -> None:
    """Before anything is said."""


class Server(ThreadingHTTPServer):
    """Gives the listed replies in turn, then the last one again and again; keeps the requests."""

    daemon_threads = True
    replies: list[Reply]
    asked: list[dict[str, Any]]
    headers: list[dict[str, str]]

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that gave up is what some tests are about."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/v1"


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.asked.append({"path": self.path, **json.loads(body)})
        self.server.headers.append(dict(self.headers.items()))
        replies = self.server.replies
        (replies.pop(0) if len(replies) > 1 else replies[0])(self)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    server = Server(("127.0.0.1", 0), Handler)
    server.replies, server.asked, server.headers = [], [], []
    with served(server):
        yield server


def ask(server: Server, timeout_s: float = 30.0) -> LanguageModel:
    return LanguageModel(server.url, "tiny", timeout_s=timeout_s, backoff_s=0.01)


def lists(*each: int) -> list[Reply]:
    """JSON lists of so many sentences, all different."""
    sentences = iter(SENTENCES)
    return [says(json.dumps([next(sentences) for _ in range(count)])) for count in each]


def held(bank: Path) -> dict[Component, list[str]]:
    found: dict[Component, list[str]] = yaml.safe_load(bank.read_text())[STOVE.suite][STOVE.name]
    return found


def counts(bank: Path) -> list[int]:
    return [len(held(bank)[component]) for component in CLASSES]


def test_a_bank_from_good_answers(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    server.replies = lists(3, 3, 3, 3)
    monkeypatch.setenv("OPENAI_API_KEY", " secret\n")
    bank = tmp_path / "bank.yaml"
    arguments = ["rewrite", str(STOVE.bddl_file), "--out", str(bank), "--per-class", "3", "--model", "tiny"]
    monkeypatch.setattr("sys.argv", ["pipeline", *arguments, "--endpoint", f"{server.url}/"])
    assert command_line.main() == 0
    assert counts(bank) == [3, 3, 3, 3]
    texts = [text for texts in held(bank).values() for text in texts]
    assert texts == list(SENTENCES[:12])
    assert {request["path"] for request in server.asked} == {"/v1/chat/completions"}
    assert {request["model"] for request in server.asked} == {"tiny"}
    assert {headers["Authorization"] for headers in server.headers} == {"Bearer secret"}
    assert "secret" not in bank.read_text() + capsys.readouterr().out


def test_a_sentence_that_plans_would_leave_out_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its distance to the test instruction "activate the cooktop" is below 0.2."""
    answers = iter([SENTENCES[0], "activate the cooktop now", *SENTENCES[1:]])
    bank = tmp_path / "bank.yaml"
    rewrite.extend(STOVE.bddl_file, bank, 1, lambda question: json.dumps([next(answers)]))
    assert counts(bank) == [1] * len(CLASSES)
    assert "cooktop" not in bank.read_text()
    assert "rejected: 1 x too close to a test instruction of LIBERO-Plus" in capsys.readouterr().out


def test_the_question_says_what_is_in_the_scene_and_what_is_wanted(server: Server, tmp_path: Path) -> None:
    server.replies = lists(1, 1, 1, 1)
    rewrite.extend(STOVE.bddl_file, tmp_path / "bank.yaml", 1, ask(server))
    questions = [request["messages"][-1]["content"] for request in server.asked]
    assert len(set(questions)) == len(CLASSES)
    for question in questions:
        for part in ("turn on the stove", "wine bottle", "wooden cabinet", "turnon(flat stove 1)", "exactly 1 "):
            assert part in question
    # What the bank has already is not asked for again.
    assert load_bank()[STOVE.suite][STOVE.name][CLASSES[0]][0] in questions[0]


def test_a_link_to_a_definition_has_the_suite_and_the_name_of_the_link(tmp_path: Path) -> None:
    link = tmp_path / "my_suite" / "my_task.bddl"
    link.parent.mkdir()
    link.symlink_to(STOVE.bddl_file)
    told = rewrite.brief(link)["task"]
    assert (told.suite, told.name, told.bddl_file) == ("my_suite", "my_task", link)


def test_two_of_a_kind_are_told_apart(server: Server) -> None:
    task = find_task(
        "libero_spatial", "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
    )
    told = rewrite.brief(task.bddl_file)
    assert told["task"] == task
    assert "2 x akita black bowl" in told["things"]
    assert "plate" in told["things"]


GOOD = "please light the big stove"


@pytest.mark.parametrize(
    "answer",
    [
        json.dumps([GOOD]),
        f"Sure! Here is the list you asked for:\n```json\n{json.dumps([GOOD])}\n```\nLet me know if you want more.",
        f"<think>the user wants [one] item</think>\n{json.dumps([GOOD])}",
        f"Here are 2 variations of the instruction:\n\n1. {GOOD.capitalize()}.\n",
        f"Of course, with pleasure\n- “{GOOD}”\n",
        json.dumps([{"rewrite": GOOD}]),
        f'["{GOOD}"]\n[Note: letters only]',
        f"```json\n[\n{json.dumps(GOOD)}\n]\n```\nsee [docs]",
        f"Here are the rewrites [1]:\n1. {GOOD}",
        f'["{GOOD}",\n"cut short before the e',
        f'[\n  "{GOOD}",\n  "cut short before the e',
        json.dumps(
            ["Sure, here is one:", f"  '{GOOD.upper()}!' ", "put milk_1 there", "wait 5 seconds", GOOD, 7, None]
        ),
    ],
)
def test_only_the_sentences_of_an_answer_are_read(server: Server, tmp_path: Path, answer: str) -> None:
    server.replies = [says(answer), *lists(1, 1, 1)]
    bank = tmp_path / "bank.yaml"
    rewrite.extend(STOVE.bddl_file, bank, 1, ask(server))
    assert held(bank)[CLASSES[0]] == [GOOD]


@pytest.mark.slow
@pytest.mark.parametrize(
    "answer", ["I'm sorry, I cannot help with that", "please light the stove", "", "[]", '{"a": 1}', "[" * 5000]
)
def test_prose_is_no_list(answer: str) -> None:
    assert rewrite.listed(answer) == []


def test_wrong_counts_are_made_up_for_and_surplus_is_left(server: Server, tmp_path: Path) -> None:
    server.replies = lists(1, 2, 9, 3, 2, 1, 3)
    bank = tmp_path / "bank.yaml"
    rewrite.extend(STOVE.bddl_file, bank, 3, ask(server))
    assert counts(bank) == [3, 3, 3, 3]
    assert [f"exactly {request['messages'][0]['content'].split('exactly ')[-1][0]}" for request in server.asked] == [
        "exactly 3",
        "exactly 2",
        "exactly 3",
        "exactly 3",
        "exactly 3",
        "exactly 1",
    ]


@pytest.mark.slow
def test_busy_and_broken_endpoints_are_asked_again(server: Server, tmp_path: Path) -> None:
    good = lists(1, 1, 1, 1)
    trouble: list[list[Reply]] = [
        [status(500), status(503, Retry_After="\u00b2"), status(429, Retry_After="0")],
        [hangs, hangs_up],
        [trickles],
        [says(None)],
    ]
    server.replies = [reply for bad, fine in zip(trouble, good, strict=True) for reply in (*bad, fine)]
    bank = tmp_path / "bank.yaml"
    rewrite.extend(STOVE.bddl_file, bank, 1, ask(server, SHORT_S))
    assert counts(bank) == [1, 1, 1, 1]
    assert len(server.asked) == 11


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        (status(200, b"<html>"), "not JSON"),
        (status(200, b"[" * 100_000), "not JSON"),
        (status(200, b'{"choices": []}'), "without choices"),
        (status(200, b"null"), "without choices"),
        (says(None), "without text"),
        (says("I would rather not."), "without a list"),
        (status(200, b"x" * (language_model.MAX_ANSWER_BYTES + 1)), "more than"),
        (says('["put plate_1 on stove_1"]'), "file-name debris"),
        (says('["turn on the stove."]'), "equal to the original"),
        (says('["turn the stove off, please"]'), "does not ask to turnon"),
        (says('["switch on the microwave oven"]'), "has no word for the flat stove"),
        (says(f'["{load_bank()[STOVE.suite][STOVE.name]["paraphrase"][0]}"]'), "a repetition"),
    ],
)
def test_an_endpoint_that_never_gives_one_is_given_up_with_the_reason(
    server: Server, tmp_path: Path, reply: Reply, reason: str
) -> None:
    server.replies = [*lists(2), reply]
    bank = tmp_path / "bank.yaml"
    with pytest.raises(PipelineError, match=rf"distraction 2, common_sense 0.*{rewrite.IDLE_ANSWERS * 3} x .*{reason}"):
        rewrite.extend(STOVE.bddl_file, bank, 2, ask(server))
    assert len(server.asked) == 1 + 3 * rewrite.IDLE_ANSWERS
    assert counts(bank) == [2, 0, 0, 0]


def test_a_run_that_stopped_goes_on(server: Server, tmp_path: Path) -> None:
    server.replies = [*lists(2, 1), status(401, b"who are you")]
    bank = tmp_path / "bank.yaml"
    bank.write_text("# Mine.\nlibero_goal:\n  other_task:\n    paraphrase:\n    - leave this alone\n")
    with pytest.raises(PipelineError, match=r"401.*who are you") as rejection:
        rewrite.extend(STOVE.bddl_file, bank, 2, ask(server))
    assert "OPENAI_API_KEY" in str(rejection.value)
    before = held(bank)
    assert [len(texts) for texts in before.values()] == [2, 1, 0, 0]
    server.replies = lists(3, 1, 2, 2)[1:]
    rewrite.extend(STOVE.bddl_file, bank, 2, ask(server))
    assert counts(bank) == [2, 2, 2, 2]
    assert all(held(bank)[component][: len(texts)] == texts for component, texts in before.items())
    assert bank.read_text().startswith("# Mine.\n")
    assert yaml.safe_load(bank.read_text())["libero_goal"]["other_task"] == {"paraphrase": ["leave this alone"]}
    asked = len(server.asked)
    rewrite.extend(STOVE.bddl_file, bank, 2, ask(server))
    assert len(server.asked) == asked


def test_comments_at_the_beginning_and_a_link_stay(server: Server, tmp_path: Path) -> None:
    server.replies = lists(1, 1, 1, 1)
    bank, link = tmp_path / "bank.yaml", tmp_path / "link.yaml"
    bank.write_text("# Mine.\n\n# Second block.\n{}\n")
    link.symlink_to(bank.name)
    rewrite.extend(STOVE.bddl_file, link, 1, ask(server))
    assert link.is_symlink()
    assert bank.read_text().startswith("# Mine.\n\n# Second block.\nlibero_goal:\n")
    assert counts(bank) == [1, 1, 1, 1]


def test_rewrites_that_were_stored_during_an_answer_stay(server: Server, tmp_path: Path) -> None:
    bank = tmp_path / "bank.yaml"
    model = ask(server)
    server.replies = lists(1, 1, 1, 1)

    def ask_while_others_write(question: str) -> str:
        answer = model(question)
        if not bank.exists():
            bank.write_text("libero_goal:\n  other_task:\n    paraphrase:\n    - leave this alone\n")
        return answer

    rewrite.extend(STOVE.bddl_file, bank, 1, ask_while_others_write)
    assert counts(bank) == [1, 1, 1, 1]
    assert yaml.safe_load(bank.read_text())["libero_goal"]["other_task"] == {"paraphrase": ["leave this alone"]}


def test_nothing_in_a_bank_is_rejected_by_the_lint_or_said_twice(server: Server, tmp_path: Path) -> None:
    mixed = [SENTENCES[0], SENTENCES[0].upper() + "!", "Turn on the stove", "x", "go to /dev", *SENTENCES[1:30]]
    server.replies = [says(json.dumps(mixed))]
    bank = tmp_path / "bank.yaml"
    with pytest.raises(PipelineError, match="a repetition"):
        rewrite.extend(STOVE.bddl_file, bank, 9, ask(server))
    texts = [text for texts in held(bank).values() for text in texts]
    linted = [lint(text, STOVE, component) for component, each in held(bank).items() for text in each]
    assert linted == [None] * len(texts)
    assert len({normalise(text) for text in texts}) == len(texts) == 30


def test_an_endpoint_out_of_reach(server: Server, tmp_path: Path) -> None:
    server.replies = [status(502, b"bad gateway")]
    with pytest.raises(PipelineError, match=f"no answer in {language_model.ATTEMPTS} attempts.*502.*bad gateway"):
        ask(server)("hello")
    assert len(server.asked) == language_model.ATTEMPTS


def test_a_redirect_is_not_followed(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "secret")
    server.replies = [status(302, Location=f"{server.url}/elsewhere")]
    with pytest.raises(PipelineError, match="302"):
        ask(server)("hello")
    assert len(server.asked) == 1


@pytest.mark.parametrize("key", ["sk-first\nsk-second", "sk-first sk-second", "sk-ü"])
def test_a_key_that_no_request_can_have_is_rejected_and_not_shown(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", key)
    with pytest.raises(PipelineError, match="OPENAI_API_KEY") as caught:
        LanguageModel("http://localhost:8000/v1", "tiny")
    assert "sk-" not in str(caught.value)


def test_messages_show_neither_the_password_nor_the_query_of_an_endpoint(server: Server) -> None:
    server.replies = [status(401, b"who are you")]
    address = server.url.replace("http://", "http://me:secret@")
    with pytest.raises(PipelineError, match="401") as caught:
        LanguageModel(f"{address}?token=secret", "tiny")("hello")
    assert "secret" not in str(caught.value)
    assert server.url.removeprefix("http://") in str(caught.value)
    with pytest.raises(PipelineError, match="401") as caught:
        LanguageModel(f"{server.url}?key=top@secret", "tiny")("hello")
    assert "secret" not in str(caught.value)
    assert server.url in str(caught.value)


@pytest.mark.parametrize(
    "endpoint",
    [
        "localhost:8000",
        "file:///etc/passwd",
        "http://",
        "me:secret@h:8000/v1",
        "ftp://me:secret@h",
        "http://me:secret@[::",
        "http://me:secret?half@h",
        "http://me:secret#half@h/v1",
    ],
)
def test_an_endpoint_that_is_no_address_is_rejected(endpoint: str) -> None:
    with pytest.raises(PipelineError, match="not an address") as caught:
        LanguageModel(endpoint, "tiny")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("(define (problem x)", "not a BDDL file"),
        ("(define (problem x) (:language do it))", "has no :objects"),
        ("(define (problem x) ())", "empty parentheses"),
        (None, "cannot be read"),
    ],
)
def test_a_file_that_is_no_task_is_rejected(tmp_path: Path, text: str | None, fault: str) -> None:
    file = tmp_path / "task.bddl"
    if text is not None:
        file.write_text(text)
    with pytest.raises(PipelineError, match=fault):
        rewrite.brief(file)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("- a list", "not a bank"),
        ("{libero_goal: {turn_on_the_stove: {riddle: [what gets hot]}}}", "not a bank"),
        ("{libero_goal: {turn_on_the_stove: {paraphrase: [stove_1 on]}}}", "stove_1 on.*file-name debris"),
        ("# mine\n\nlibero_goal: {} # checked\n", "comments between its rewrites, which would be lost"),
        ("name: mine\nplan: {episodes: {camera: 1}}", r"bank of rewrites \(name: [^\n]*\)\n"),
    ],
)
def test_a_bank_that_is_none_is_left_alone(server: Server, tmp_path: Path, text: str, fault: str) -> None:
    bank = tmp_path / "bank.yaml"
    bank.write_text(text)
    with pytest.raises(PipelineError, match=fault):
        rewrite.extend(STOVE.bddl_file, bank, 1, ask(server))
    assert bank.read_text() == text
    assert server.asked == []
