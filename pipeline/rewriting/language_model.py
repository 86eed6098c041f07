"""Client that asks a language model behind an OpenAI-compatible endpoint, and its errors."""

import json
import os
import re
import time
import urllib.parse
from dataclasses import dataclass
from functools import cache

import httpx

from pipeline.errors import PipelineError

ATTEMPTS = 4
LONGEST_WAIT_S = 60.0
MAX_ANSWER_BYTES = 1_000_000

PRINTABLE = re.compile(r"[!-~]*")
"""Text that can be a header's value: ASCII without spaces and line breaks."""


class UnusableError(Exception):
    """Answer of the endpoint that is no completion; a second attempt may help."""


class _BusyError(Exception):
    """Failure of an endpoint that may answer later.

    Attributes:
        wait_s: waiting time that the endpoint asked for.
    """

    def __init__(self, fault: str, wait_s: float = 0.0):
        """Describe the ``fault`` of the attempt."""
        super().__init__(fault)
        self.wait_s = wait_s


@dataclass(frozen=True)
class LanguageModel:
    """Language model to ask. A key, if needed, comes from the environment variable ``OPENAI_API_KEY``.

    Attributes:
        endpoint: address that ``/chat/completions`` is appended to, such as ``http://localhost:8000/v1``.
        model: name of the model at the endpoint.
        timeout_s: time limit for one whole answer.
        backoff_s: waiting time before the second attempt; it doubles with each attempt, up to ``LONGEST_WAIT_S``.
    """

    endpoint: str
    model: str
    timeout_s: float = 120.0
    backoff_s: float = 2.0

    def __post_init__(self) -> None:
        """Check the endpoint's address and the key, which an error does not show."""
        try:
            address = urllib.parse.urlsplit(self.endpoint)
            is_address = address.scheme in ("http", "https") and bool(address.hostname) and address.port != 0
        except ValueError:  # such as a port that is no number
            is_address = False
        if not is_address:
            raise PipelineError(
                "the endpoint is not an address",
                where=f"endpoint {_without_secrets(self.endpoint)!r}",
                expected="such as http://localhost:8000/v1",
            )
        if not PRINTABLE.fullmatch(_key()):
            raise PipelineError(
                "the key contains a space, a line break or a character that is not ASCII",
                where="environment variable OPENAI_API_KEY",
                expected="one key",
            )

    def __call__(self, prompt: str) -> str:
        """Return the model's answer to ``prompt``; try up to ``ATTEMPTS`` times while the endpoint is busy.

        Raises:
            UnusableError: when the answer is no completion.
            PipelineError: when the endpoint rejects the question, or stays out of reach.
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
            where=_without_secrets(self._url),
            remedy="check that the server runs and keeps up, then run the command again: accepted rewrites are kept",
        )

    @property
    def _url(self) -> str:
        """Address for chat completions."""
        return f"{self.endpoint.rstrip('/')}/chat/completions"

    def _post(self, prompt: str) -> bytes:
        """Send a prompt once and return the body of the answer.

        Raises:
            _BusyError: when a later attempt may succeed.
            UnusableError: when the answer is too long.
            PipelineError: when the address is not usable, or the endpoint rejects the question.
        """
        question = {"model": self.model, "messages": [{"role": "user", "content": prompt}]}
        key = _key()
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        body, deadline = b"", time.monotonic() + self.timeout_s
        try:
            client = _client()
            # The client follows no redirect, because a redirect would show the key to another server.
            with client.stream("POST", self._url, json=question, headers=headers, timeout=self.timeout_s) as response:
                for piece in response.iter_bytes():
                    body += piece
                    if len(body) > MAX_ANSWER_BYTES:
                        raise UnusableError(f"an answer of more than {MAX_ANSWER_BYTES} bytes")
                    # The client's timeout limits each piece, not the whole answer.
                    if time.monotonic() > deadline:
                        raise TimeoutError(f"no whole answer within {self.timeout_s:g} s")
        except (httpx.InvalidURL, ImportError, ValueError) as error:  # a proxy in the environment raises the last two
            raise PipelineError(
                f"the endpoint cannot be asked ({error})",
                where=_without_secrets(self._url),
                expected="an http or https address",
            ) from error
        except (OSError, httpx.HTTPError) as error:
            raise _BusyError(str(error) or type(error).__name__) from error
        if response.is_success:
            return body
        message = " ".join(body[:300].decode(errors="replace").split())
        fault = f"HTTP status {response.status_code} {response.reason_phrase}: {message}".rstrip(": ")
        if response.status_code == 429 or response.is_server_error:
            retry_after = response.headers.get("Retry-After", "")
            raise _BusyError(fault, float(retry_after) if re.fullmatch("[0-9]+", retry_after) else 0.0)
        raise PipelineError(
            f"the endpoint rejects the question ({fault})",
            where=_without_secrets(self._url),
            expected=f"a chat completion by the model {self.model!r}",
            remedy="check the endpoint, the model's name and the environment variable OPENAI_API_KEY",
        )


_HOST = re.compile(r"([a-z]+://)?([^/:]*|\[[0-9a-fA-F:.]*\])(:\d*)?(/(?!/).*)?")
"""Address without user and password, query and fragment."""


def _without_secrets(address: str) -> str:
    """Return an address for messages: the part after user and password, without query and fragment.

    A malformed address may have a part of a password before its first ``?`` or ``#``, and is not shown.
    """
    shown = re.split("[?#]", address)[0].rpartition("@")[2]
    return shown if _HOST.fullmatch(shown) else "(not shown)"


def _key() -> str:
    """Return the key for the endpoint, empty if there is none."""
    return os.environ.get("OPENAI_API_KEY", "").strip()


@cache
def _client() -> httpx.Client:
    """Return this process's client; creating one takes 0.05 s."""
    return httpx.Client()


def _content(body: bytes) -> str:
    """Return the text of a completion.

    Raises:
        UnusableError: when ``body`` is no completion.
    """
    try:
        content = json.loads(body)["choices"][0]["message"]["content"]
    except (ValueError, RecursionError) as error:
        raise UnusableError("an answer that is not JSON") from error
    except (LookupError, TypeError) as error:
        raise UnusableError("an answer without choices") from error
    if not isinstance(content, str):
        raise UnusableError("an answer without text")
    return content
