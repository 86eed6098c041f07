"""One question to a language model behind an OpenAI-compatible endpoint, and the ways in which it can go wrong."""

from __future__ import annotations

import http.client
import json
import os
import time
import urllib.error
import urllib.parse
import urllib.request
from dataclasses import dataclass

from pipeline.errors import PipelineError

ATTEMPTS = 4
LONGEST_WAIT_S = 60.0
MAX_ANSWER_BYTES = 1_000_000


class UnusableError(Exception):
    """The endpoint answered, but not with a completion; asking again may help."""


class _BusyError(Exception):
    """The endpoint may answer later.

    Args:
        fault: what happened.
        wait_s: how long it asked to be left alone.
    """

    def __init__(self, fault: str, wait_s: float = 0.0):
        super().__init__(fault)
        self.wait_s = wait_s


class _StayHere(urllib.request.HTTPRedirectHandler):
    """Follows no redirect: it would drop the question, and show the key to whoever it leads to."""

    def redirect_request(self, *_: object) -> None:
        return None


@dataclass(frozen=True)
class LanguageModel:
    """A model to ask. The key, where one is needed, comes from the environment variable ``OPENAI_API_KEY``.

    Attributes:
        endpoint: address that ``/chat/completions`` is appended to, such as ``http://localhost:8000/v1``.
        model: its name there.
        timeout_s: for one whole answer.
        backoff_s: before the second attempt; twice that before the third, and so on, up to ``LONGEST_WAIT_S``.
    """

    endpoint: str
    model: str
    timeout_s: float = 120.0
    backoff_s: float = 2.0

    def __post_init__(self) -> None:
        address = urllib.parse.urlsplit(self.endpoint)
        if address.scheme not in ("http", "https") or not address.hostname:
            raise PipelineError(
                "not an address", where=f"endpoint {self.endpoint!r}", expected="such as http://localhost:8000/v1"
            )

    def __call__(self, prompt: str) -> str:
        """The model's answer to ``prompt``; tries again, ``ATTEMPTS`` times in all, while the endpoint is busy.

        Raises:
            UnusableError: when what came back is no completion.
            PipelineError: when the endpoint refuses the question, or stays out of reach.
        """
        wait_s = self.backoff_s
        faults: list[str] = []
        while len(faults) < ATTEMPTS:
            try:
                return _content(self._post(prompt))
            except _BusyError as busy:
                faults.append(str(busy))
                if len(faults) < ATTEMPTS:
                    time.sleep(min(max(wait_s, busy.wait_s), LONGEST_WAIT_S))
                wait_s *= 2
        raise PipelineError(
            f"no answer in {ATTEMPTS} attempts: {'; '.join(dict.fromkeys(faults))}",
            where=self._url,
            remedy="see that the server runs and keeps up, then run it again: what was accepted so far is kept",
        )

    @property
    def _url(self) -> str:
        return f"{self.endpoint.rstrip('/')}/chat/completions"

    def _post(self, prompt: str) -> bytes:
        question = {"model": self.model, "messages": [{"role": "user", "content": prompt}]}
        headers = {"Content-Type": "application/json"}
        if key := os.environ.get("OPENAI_API_KEY", "").strip():
            headers["Authorization"] = f"Bearer {key}"
        request = urllib.request.Request(self._url, json.dumps(question).encode(), headers)
        deadline = time.monotonic() + self.timeout_s
        try:
            with urllib.request.build_opener(_StayHere).open(request, timeout=self.timeout_s) as response:
                return self._read(response, deadline)
        except urllib.error.HTTPError as error:
            fault = f"HTTP status {error.code} {error.reason}: {_said(error)}".rstrip(": ")
            if error.code == 429 or error.code >= 500:
                after = error.headers.get("Retry-After", "")
                raise _BusyError(fault, float(after) if after.isdigit() else 0.0) from error
            raise PipelineError(
                f"the endpoint refuses the question ({fault})",
                where=self._url,
                expected=f"a chat completion by the model {self.model!r}",
                remedy="check the endpoint, the model's name and the environment variable OPENAI_API_KEY",
            ) from error
        except (OSError, http.client.HTTPException) as error:
            raise _BusyError(str(getattr(error, "reason", error)) or type(error).__name__) from error

    def _read(self, response: http.client.HTTPResponse, deadline: float) -> bytes:
        """The body; the timeout of a socket is for each piece of it, so a trickle is cut off here."""
        body = b""
        while piece := response.read1(65536):
            body += piece
            if len(body) > MAX_ANSWER_BYTES:
                raise UnusableError(f"an answer of more than {MAX_ANSWER_BYTES} bytes")
            if time.monotonic() > deadline:
                raise TimeoutError(f"no whole answer within {self.timeout_s:g} s")
        return body


def _said(error: urllib.error.HTTPError) -> str:
    """The beginning of what came with an error."""
    try:
        return " ".join(error.read(300).decode(errors="replace").split())
    except (OSError, http.client.HTTPException):
        return ""


def _content(body: bytes) -> str:
    """The text of a completion."""
    try:
        content = json.loads(body)["choices"][0]["message"]["content"]
    except (ValueError, RecursionError) as error:
        raise UnusableError("an answer that is not JSON") from error
    except (LookupError, TypeError) as error:
        raise UnusableError("an answer without choices") from error
    if not isinstance(content, str):
        raise UnusableError("an answer without text")
    return content
