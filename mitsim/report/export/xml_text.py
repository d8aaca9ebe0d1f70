"""Text that XML 1.0 allows."""

from __future__ import annotations

import re

#: characters that XML 1.0 does not allow (section 2.2): file names may have them
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def xml_text(text: str) -> str:
    """Return a text with the characters that XML 1.0 does not allow as escapes."""
    return _NOT_XML.sub(lambda found: ascii(found[0])[1:-1], text)
