"""Waiting for the kernel, where it can be waited for."""

import platform

import pytest

from edoras_tools.io.capture import barrier


@pytest.fixture(autouse=True)
def fresh():
    barrier.available.cache_clear()
    yield
    barrier.available.cache_clear()


def test_it_waits_where_it_says_so():
    assert barrier.available() == barrier.wait() or not barrier.available()


@pytest.mark.parametrize("known", [-1, 0, 0b110])
def test_a_kernel_without_the_call(monkeypatch, known):
    monkeypatch.setattr(barrier, "_call", lambda _: known)
    assert not barrier.available()


def test_an_unknown_machine(monkeypatch):
    monkeypatch.setattr(platform, "machine", lambda: "abacus")
    assert not barrier.available()


def test_a_real_time_kernel(monkeypatch, tmp_path):
    monkeypatch.setattr(barrier, "_REAL_TIME", tmp_path)
    assert not barrier.available()
