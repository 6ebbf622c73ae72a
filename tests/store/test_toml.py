"""TOML of users: integers that TOML does not have are refused wherever they stand."""

import pytest

from gyrostab.store.toml import parse_toml


@pytest.mark.parametrize("number", [2**63 - 1, -(2**63)])
def test_integers_of_64_bits_are_read(number):
    assert parse_toml(f"a = [{number}]") == {"a": [number]}


@pytest.mark.parametrize("text", ["a = {}", "[a]\nb = [[0.0, {}]]", "[[a]]\nb = {{c = {}}}"])
@pytest.mark.parametrize("number", [2**63, -(2**63) - 1, 10**400])
def test_longer_integers_are_refused(text, number):
    with pytest.raises(ValueError, match="64 are the most"):
        parse_toml(text.format(number))
