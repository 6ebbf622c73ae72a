"""TOML of users: encodings, and integers that TOML does not have."""

import pytest

from gyrostab.cli.options import read_toml
from gyrostab.errors import FormatError, OptionError
from gyrostab.simulate import read_model
from gyrostab.store.toml import parse_toml

_MODEL = "[noise]\r\nN = 0.01  # Grad je Wurzel Stunde, für alle\r\n"


def test_byte_order_mark_and_line_ends_of_windows_are_read(tmp_path):
    path = tmp_path / "model.toml"
    path.write_bytes(_MODEL.encode("utf-8-sig"))
    assert read_model(path).coefficients("x")["N"] == 0.01
    assert read_toml(path) == {"noise": {"N": 0.01}}


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
@pytest.mark.parametrize(("read", "error"), [(read_model, FormatError), (read_toml, OptionError)])
def test_other_encodings_are_refused_with_advice(read, error, encoding, tmp_path):
    path = tmp_path / "model.toml"
    path.write_bytes(_MODEL.encode(encoding))
    with pytest.raises(error, match=r"model\.toml: .*not text in UTF-8; save it as UTF-8"):
        read(path)


@pytest.mark.parametrize("number", [2**63 - 1, -(2**63)])
def test_integers_of_64_bits_are_read(number):
    assert parse_toml(f"a = [{number}]") == {"a": [number]}


@pytest.mark.parametrize("text", ["a = {}", "[a]\nb = [[0.0, {}]]", "[[a]]\nb = {{c = {}}}"])
@pytest.mark.parametrize("number", [2**63, -(2**63) - 1, 10**400])
def test_longer_integers_are_refused(text, number):
    with pytest.raises(ValueError, match="64 are the most"):
        parse_toml(text.format(number))
