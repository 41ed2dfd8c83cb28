"""The encoding of a text: that of its byte order mark, UTF-8, or what chardet finds."""

from __future__ import annotations

import codecs
import re

from lipcore.extras import import_extra

MAX_BYTES = 16 * 1024
"""Max bytes that chardet reads."""
FALLBACK = "cp1252"
"""Encoding of text that is not UTF-8, if chardet is not certain: that of Windows in western countries."""
MIN_CONFIDENCE = 0.5
MIN_ZEROS = 0.5
"""Min share of zeros in the upper bytes of UTF-16."""
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_BINARY = re.compile(r"[\0-\x06\x0e-\x1a\x1c-\x1f]")


def decode_head(head: bytes, whole: bool) -> tuple[str, str] | None:
    """Return the encoding and the text of the first bytes of a file, or of all (`whole`); None if it is not text.

    UTF-8 may hold control characters, as in a damaged file. Without chardet, few other encodings are read.
    """
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), None) or _find_wide(head)
    if (text := _decode(head, encoding or "utf-8", whole)) is not None:
        return encoding or "utf-8", text
    found = import_extra("chardet", "ingest").detect(head[:MAX_BYTES])
    encoding = str(found["encoding"]) if found["confidence"] >= MIN_CONFIDENCE else FALLBACK
    text = _decode(head, encoding, whole)
    return None if text is None or _BINARY.search(text) else (encoding, text)


def _find_wide(head: bytes) -> str | None:
    """Return UTF-16 without a mark: text with Latin letters and numbers has zeros in every second byte."""
    even, odd = head[::2].count(0), head[1::2].count(0)
    if max(even, odd) < MIN_ZEROS * len(head) / 2 or min(even, odd) > 0:
        return None
    return "utf-16-le" if odd else "utf-16-be"


def _decode(head: bytes, encoding: str, whole: bool) -> str | None:
    try:
        return codecs.getincrementaldecoder(encoding)().decode(head, final=whole)
    except (UnicodeDecodeError, LookupError):
        return None
