"""The checksum of chunks against that of numcodecs."""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numcodecs import Fletcher32

from gyrostab.kernels.encoding.checksum import fletcher32


def by_numcodecs(data: np.ndarray) -> int:
    return int.from_bytes(bytes(Fletcher32().encode(data))[-4:], "little")


@given(
    hnp.arrays(
        np.uint8, st.integers(1, 1100), elements=st.integers(0, 255) | st.sampled_from([0, 255])
    )
)
@example(np.zeros(100, np.uint8))
@example(np.full(720, 255, np.uint8))
@example(np.array([255, 254, 0, 1], np.uint8))  # the words add up to 65535
@example(np.array([0, 0, 7], np.uint8))
def test_checksum_equals_that_of_numcodecs(data):
    assert fletcher32(data) == by_numcodecs(data)


@pytest.mark.parametrize("size", [1_920_000, 1_318_481])
def test_checksum_of_a_whole_chunk(size):
    data = np.random.default_rng(size).integers(0, 256, size, dtype=np.uint8)
    assert fletcher32(data) == by_numcodecs(data)
