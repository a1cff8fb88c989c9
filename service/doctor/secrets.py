"""Finds passwords and tokens, so that they are in nothing that is sent to others.

Two nets. Values that are known (password files, secret variables) are found wherever they are, also as Base64, in
hexadecimal digits, quoted for an address or for JSON. And whatever looks like a secret is removed, known or not: what
is given to a name such as `password` or `token`, credentials in an address, private keys, web tokens. Rather too much
is removed than too little. Text is read line by line, and only the few lines that have a suspicious word are looked at
closely, so that a long log takes a moment.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any
from urllib.parse import quote, quote_plus

REMOVED = "[removed]"

SHORTEST = 4
"""Characters of a known value that is looked for within words; a shorter one is removed only as a whole word."""

LONGEST_LINE = 10_000
"""Characters of a suspicious line that is looked at closely; a longer one is removed as a whole."""

NAMES = "password passwd passphrase passcode pwd secret token apikey api_key api-key accesskey access_key access-key"
NAMES += " privatekey private_key private-key credential cookie authorization"
"""Parts of names, in small letters, whose value is secret."""

_NAMES = tuple(NAMES.split())
_NAME = "|".join(map(re.escape, _NAMES))
_SUSPICIOUS = (*_NAMES, "://", "eyj", "bearer ", "basic ", "digest ")
_KEY = re.compile(r"-----BEGIN [A-Z ]{0,64}PRIVATE KEY-----.*?(?:-----END [A-Z ]{0,64}PRIVATE KEY-----|\Z)", re.DOTALL)
_GIVEN = re.compile(
    rf"""((?:{_NAME})[\w.-]{{0,64}}\\?["']?\s*[:=]\s*)(?:(["'])(?:[^"'\\]|\\.|(?!\2)["'])*\2|.+)""", re.IGNORECASE
)
"""NAME = "value", NAME: 'value', "NAME": "value"; a value without quotation marks reaches to the end of its line."""
_OPEN = re.compile(rf"(?:{_NAME})[\w.-]{{0,64}}[\"']?\s*[:=]\s*[|>]?\s*$", re.IGNORECASE)
"""A name whose value is in the next line."""
_PATTERNS = (
    (re.compile(r"(://)[^/\s@\"']{0,256}:[^/\s\"']{0,256}(?=@)"), rf"\1{REMOVED}"),
    (re.compile(r"\beyJ[\w-]{8,}\.[\w-]+\.[\w-]*"), REMOVED),
    (re.compile(r"\b(bearer|basic|digest)\s+[^\s\"',;]+", re.IGNORECASE), rf"\1 {REMOVED}"),
)
_FILE = re.compile(rf"(?:{_NAME})_?file\s*=\s*[\"']+([^\"'\n]+)", re.IGNORECASE)
_WORDS = re.compile(r"[^\s\0]+")


def is_secret_name(name: str) -> bool:
    """Whether what has this name is a secret."""
    small = name.lower()
    return any(part in small for part in _NAMES)


class Redactor:
    """Removes the `known` values, in all their forms, and whatever looks like a secret."""

    def __init__(self, known: Iterable[str] = ()) -> None:
        values = {line.strip() for each in known for line in each.splitlines()} - {""}
        long = [value for value in values if len(value) >= SHORTEST]
        plain = sorted({form for value in long for form in _forms(value)}, key=len, reverse=True)
        coded = sorted({form for value in long for form in _base64(value)}, key=len, reverse=True)
        # The longest first, as a form may be a part of another one. Digits of Base64 beside it have some of its bits.
        parts = [rf"[\w+/-]?{re.escape(form)}[\w+/=-]{{0,3}}" for form in coded]
        parts += [re.escape(form) for form in plain]
        parts += [rf"(?<!\w){re.escape(word)}(?!\w)" for word in values.difference(long)]
        self._forms = (*plain, *coded)
        self._texts = (*self._forms, *values.difference(long))
        self._known = re.compile("|".join(parts)) if parts else None

    def text(self, text: str) -> str:
        """The text without secrets."""
        lines = _KEY.sub(REMOVED, text).split("\n")
        known = self._known if any(each in text for each in self._texts) else None
        continued = False
        for number, line in enumerate(lines):
            if known is not None:
                line = known.sub(REMOVED, line)
            if continued:
                line, continued = REMOVED, False
            else:
                small = line.lower()
                if any(part in small for part in _SUSPICIOUS):
                    continued = _OPEN.search(line[-LONGEST_LINE:]) is not None
                    line = _without_secrets(line) if len(line) <= LONGEST_LINE else REMOVED
            lines[number] = line
        return "\n".join(lines)

    def document(self, value: Any) -> Any:
        """A JSON document without secrets: by the names of its keys, and in its texts."""
        if isinstance(value, Mapping):
            return {
                self.text(str(key)): REMOVED if item and is_secret_name(str(key)) else self.document(item)
                for key, item in value.items()
            }
        if isinstance(value, list | tuple):
            return [self.document(item) for item in value]
        return self.text(value) if isinstance(value, str) else value

    def holds_known(self, content: bytes) -> bool:
        """Whether a known value is in these bytes. Of a file that is not text nothing can be removed."""
        return any(form.encode() in content for form in self._forms)


def _without_secrets(line: str) -> str:
    for pattern, replacement in _PATTERNS:
        line = pattern.sub(replacement, line)
    line = _GIVEN.sub(lambda found: f"{found[1]}{found[2] or ''}{REMOVED}{found[2] or ''}", line)
    for option, value in reversed(_options(line)):
        if is_secret_name(option[0]):
            line = f"{line[: value.start()]}{REMOVED}{line[value.end() :]}"
    return line


def _options(line: str) -> list[tuple[re.Match[str], re.Match[str]]]:
    """Each `--option` of a command line with the word after it, unless that is an option, too."""
    words = _WORDS.finditer(line)
    pairs = pairwise(words)
    return [(one, two) for one, two in pairs if one[0].startswith("-") and "=" not in one[0] and two[0][0] != "-"]


def _forms(value: str) -> set[str]:
    """How a value may be written down, except in Base64."""
    content = value.encode()
    forms = {value, json.dumps(value)[1:-1], json.dumps(value, ensure_ascii=False)[1:-1], repr(value)[1:-1]}
    return forms | {quote(value, safe=""), quote_plus(value), content.hex(), content.hex().upper()}


def _base64(value: str) -> set[str]:
    """The digits that a value alone decides, wherever it stands in what is encoded, as in USER:PASSWORD."""
    content = value.encode()
    forms = set()
    for encode in (base64.b64encode, base64.urlsafe_b64encode):
        for shift in range(3):
            first, last = (8 * shift + 5) // 6, 8 * (shift + len(content)) // 6
            forms.add(encode(bytes(shift) + content).decode()[first:last])
    return {form for form in forms if len(form) >= SHORTEST}


def of_environment(environment: Mapping[str, str]) -> set[str]:
    """The values of variables that have the name of a secret."""
    return {value for name, value in environment.items() if is_secret_name(name) and not name.upper().endswith("FILE")}


def files_in(text: str) -> set[str]:
    """The files with secrets that a vehicle file names, even one that cannot be used for a mistake elsewhere."""
    return set(_FILE.findall(text))


def files_of(environment: Mapping[str, str]) -> set[str]:
    """The files with secrets that variables name, as $TOKEN_FILE."""
    return {value for name, value in environment.items() if is_secret_name(name) and name.upper().endswith("FILE")}


def files_on(words: Iterable[str]) -> set[str]:
    """The files with secrets that a command line names, as `--password-file FILE`."""
    found = set[str]()
    before = ""
    for word in words:
        name, equals, value = word.partition("=")
        if equals and name.startswith("--") and is_secret_name(name):
            found.add(value)
        elif before.startswith("--") and "=" not in before and is_secret_name(before):
            found.add(word)
        before = word
    return found
