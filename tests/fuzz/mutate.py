"""Damage bytes like a bad cable, a full disk, a careless editor or an attacker."""

from __future__ import annotations

import random
import re

from tests.fuzz.seeds import Seed

#: Critical values of counters, sizes and signs.
INTEGERS = (
    0,
    1,
    2,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    2**40,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
#: Critical texts for parsers.
TOKENS = (
    b"",
    b"nan",
    b"-nan",
    b"inf",
    b"1e999",
    b"-1e-320",
    b"-0",
    b"0",
    b"1",
    b"-1",
    b"9" * 5000,
    b"1e300",
    b"0x10",
    b"1_0",
    b"+",
    b"-",
    b".",
    b"e5",
    b"2300-01-01T00:00:00",
    b"1500-01-01",
    b"2026-02-30",
    b"2026-03-01T25:00:00Z",
    b"9223372036854775807",
    b"9223372036854775808",
    b"1e19",
    b"\xff\xfe",
    b"\x00",
    b'"',
    b"'",
    b"#",
    b"[",
    b"]",
    b"[]",
    b"{}",
    b"null",
    b"true",
    b"\xc2\xb5s",
    b"time",
    b"gyro_x",
    b"[deg/h]",
    b"deg/s",
    b"1,5",
    b"\r",
    b"\n",
    b"\t",
    b"0.1 arcsec/s",
    b"{{7*7}}",
    b"$\\frac{$",
    b"<svg>",
    b"/",
    b"../x",
    b"\xf0\x9f\x8c\x8d",
    b"1e-300",
    b"1" + b"0" * 400,
    b"seconds since now",
    b"[[[[[[[[[[",
    b'"""',
)
_TOKEN = re.compile(rb"[^\s,;=\[\]{}:\"]+|[,;=\[\]{}:\"\n]")
TEXT = ("text", "las", "layout", "model", "options")


def damage(seed: Seed, others: list[Seed], draw: random.Random) -> dict[str, bytes]:
    """Return the files of a seed, with one or several of them damaged."""
    files = dict(seed.files)
    names = [name for name in files if name not in seed.keep]
    small = [name for name in names if len(files[name]) < 4096]
    for _ in range(1 if draw.random() < 0.7 else draw.randint(2, 4)):
        name = draw.choice(small if small and draw.random() < 0.5 else names)
        if len(names) > 1 and draw.random() < 0.06:
            files.pop(name, None)
            continue
        if len(names) > 1 and draw.random() < 0.06:
            files[name] = files.get(draw.choice(names), b"")
            continue
        other = draw.choice(others)
        spare = other.files[draw.choice(list(other.files))]
        textual = seed.format in TEXT or (
            name in files
            and name.endswith((".json", ".zarray", ".zattrs", ".zmetadata", ".zgroup"))
        )
        files[name] = damage_bytes(
            files.get(name, b""), spare, draw, textual=textual and not name.endswith(".gz")
        )
    return files


def damage_bytes(data: bytes, spare: bytes, draw: random.Random, *, textual: bool) -> bytes:
    """Damage bytes in one or several ways."""
    for _ in range(draw.choice((1, 1, 1, 2, 3, 8))):
        data = (
            replace_token(data, draw)
            if textual and draw.random() < 0.6
            else damage_once(bytearray(data), spare, draw)
        )
    return data


def place_in(data: bytes | bytearray, draw: random.Random) -> int:
    """Draw a position, half of the time near one of the ends, where headers and footers are."""
    kind = draw.random()
    if kind < 0.35:
        return draw.randrange(min(len(data), 512))
    if kind < 0.5:
        return len(data) - 1 - draw.randrange(min(len(data), 512))
    return draw.randrange(len(data))


def damage_once(data: bytearray, spare: bytes, draw: random.Random) -> bytes:
    if not data:
        return bytes(draw.randbytes(draw.randint(1, 64)))
    at = place_in(data, draw)
    length = draw.choice((1, 2, 4, 8, 16, 64, 256))
    kind = draw.randrange(9)
    if kind <= 1:
        data[at] ^= 1 << draw.randrange(8)
    elif kind == 2:
        data[at] = draw.randrange(256)
    elif kind == 3:
        width = draw.choice((1, 2, 4, 8))
        number = draw.choice(INTEGERS) % 256**width
        data[at : at + width] = number.to_bytes(width, draw.choice(("little", "big")))
    elif kind == 4:
        del data[at : at + length]
    elif kind == 5:
        data[at:at] = draw.randbytes(length)
    elif kind == 6:
        data[at:at] = data[at : at + length] * draw.choice((1, 2, 20))
    elif kind == 7:
        del data[at:]
    else:
        begin = draw.randrange(max(1, len(spare)))
        data[at : at + draw.choice((0, length))] = spare[begin : begin + length]
    return bytes(data)


def replace_token(data: bytes, draw: random.Random) -> bytes:
    tokens = list(_TOKEN.finditer(data))
    if not tokens:
        return draw.choice(TOKENS)
    chosen = (
        tokens[draw.randrange(min(len(tokens), 60))] if draw.random() < 0.5 else draw.choice(tokens)
    )
    kind = draw.random()
    new = (
        draw.choice(TOKENS)
        if kind < 0.7
        else draw.choice(tokens)[0]
        if kind < 0.9
        else chosen[0] * 2
    )
    return data[: chosen.start()] + new + data[chosen.end() :]
