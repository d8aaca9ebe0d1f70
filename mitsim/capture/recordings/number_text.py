"""Read numbers in the text of other programs, with every spelling of NaN and infinity that C libraries write."""

from __future__ import annotations

import re

#: Microsoft's C library writes 1.#QNAN, -1.#IND and 1.#INF, since 2015 -nan(ind) and nan(snan); glibc and BSD add the
#: payload, as in nan(0x123)
_NAN = re.compile(rb"(?i)[-+]?(?:nan\([a-z0-9_]*\)|1\.#(?:qnan|snan|ind|nan)[0-9]*)")
_INFINITE = re.compile(rb"(?i)([-+]?)1\.#inf[0-9]*")


def number_words(text: bytes) -> list[str]:
    """Return the words of a text of numbers, which ``float`` reads.

    Raises
    ------
    UnicodeDecodeError
        If the text is not ASCII; it is a ``ValueError``.
    """
    if b"#" in text or b"(" in text:
        text = _INFINITE.sub(rb"\1inf", _NAN.sub(b"nan", text))
    return text.decode("ascii").split()
