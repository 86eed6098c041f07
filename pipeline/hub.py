"""The Hugging Face hub: errors of its client."""

import httpx
from huggingface_hub import errors

TRANSFER_ERRORS = (
    OSError,
    RuntimeError,
    ValueError,
    httpx.HTTPError,
    httpx.InvalidURL,
    getattr(errors, "XetError", OSError),
)
"""Errors of a download or an upload.

Only huggingface-hub before version 1 has a ``XetError``; only later versions use httpx. The package hf_xet, which
transfers the content of files, may raise a ``RuntimeError``.
"""
