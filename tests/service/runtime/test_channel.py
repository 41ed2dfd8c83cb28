"""Channels between processes: messages of all sizes, file descriptors, closed ends and damaged messages."""

import ctypes
import gc
import mmap
import os
import pickle
import socket
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from service.runtime import pages
from service.runtime.channel import MAX_FDS, MAX_MESSAGE_BYTES, MIN_SHARED_BYTES, Channel, Package, share


@pytest.fixture
def ends():
    """Two ends of a channel, and the socket of the first."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    one, other = Channel(ours), Channel(theirs)
    yield one, other, ours
    one.close()
    other.close()


def count_fds():
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


def arrays(size):
    """Return a message whose arrays have about this size, in bytes."""
    rng = np.random.default_rng(size)
    return {"a": rng.normal(size=max(size // 16, 1)), "b": rng.normal(size=(2, max(size // 32, 1))), "text": "x" * 9}


@pytest.mark.parametrize("size", [0, 100, MIN_SHARED_BYTES - 500, MIN_SHARED_BYTES, 10 * MAX_MESSAGE_BYTES, 30_000_000])
def test_arrays_arrive_as_sent(ends, size):
    one, other, _ = ends
    message, before = arrays(size), count_fds()
    assert one.send(message)
    found, fds = other.receive()
    assert fds == []
    for name in ("a", "b"):
        np.testing.assert_array_equal(found[name], message[name])
        found[name][...] = 1.0  # writable, and of this receiver alone
    assert found["text"] == message["text"]
    assert count_fds() == before


@pytest.mark.parametrize("count", [10, 100_000])
def test_messages_without_arrays_may_be_large(ends, count):
    one, other, _ = ends
    message = {("model", number): number for number in range(count)}
    assert one.send(message)
    assert other.receive() == (message, [])


def test_descriptors_arrive_with_large_messages(ends):
    one, other, _ = ends
    before, (read, write) = count_fds(), os.pipe()
    for size in (10, 1_000_000):
        assert one.send(arrays(size), [write])
        _, (received,) = other.receive()
        assert not os.get_inheritable(received)
        os.write(received, b"hello")
        assert os.read(read, 5) == b"hello"
        os.close(received)
    os.close(read)
    os.close(write)
    assert count_fds() == before


def test_receivers_of_a_package_share_its_pages(ends):
    """A page that both have mapped counts half for each of them in /proc/self/smaps."""
    one, other, _ = ends
    package, before, mapped = Package.of(np.ones(1_000_000)), count_fds(), proportional_kib("lipserve")
    assert package.size >= 8_000_000
    for _ in range(2):
        assert one.send(package)
    found = [other.receive()[0] for _ in range(2)]
    package.close()
    package.close()
    assert [each.sum() for each in found] == [1_000_000.0] * 2
    assert 0.9 * 8_000_000 / 1024 < proportional_kib("lipserve") - mapped < 1.1 * 8_000_000 / 1024
    assert count_fds() == before - 1
    del found
    gc.collect()
    assert proportional_kib("lipserve") <= mapped


def proportional_kib(name):
    """Return the proportional size of all mappings of files in memory of a name, KiB."""
    with open("/proc/self/smaps") as file:
        size, counts = 0, False
        for line in file:
            if "-" in line.split()[0]:
                counts = f"/memfd:{name}" in line
            elif counts and line.startswith("Pss:"):
                size += int(line.split()[1])
    return size


def test_shared_objects_are_passed_on_without_a_copy(ends):
    """The receiver maps the same pages, and further arrays travel with them."""
    one, other, _ = ends
    before, mapped = count_fds(), proportional_kib("lipserve")
    ours = share({"a": np.ones(1_000_000), "b": np.asfortranarray(np.arange(12_000.0).reshape(3, -1))})
    assert count_fds() == before + 1
    message = {**ours, "part": ours["a"][500_000:], "own": np.full(10_000, 2.0), "empty": np.empty(0)}
    package = Package.of(message)
    assert package.size < 200_000
    assert one.send(package)
    package.close()
    theirs, fds = other.receive()
    assert fds == []
    for name in ("a", "b", "part", "own", "empty"):
        np.testing.assert_array_equal(theirs[name], message[name])
    assert proportional_kib("lipserve") - mapped < 1.1 * 8_000_000 / 1024
    theirs["a"][0] = 5.0  # of this receiver alone
    assert ours["a"][0] == 1.0
    del ours, message, package
    assert count_fds() == before  # the receiver needs none
    assert theirs["part"].sum() == 500_000.0
    del theirs
    gc.collect()
    assert proportional_kib("lipserve") <= mapped


def test_arrays_of_more_files_than_a_message_carries_are_copied(ends):
    one, other, _ = ends
    before = count_fds()
    shared = [share(np.full(100_000, float(number))) for number in range(MAX_FDS + 2)]
    assert one.send(shared)
    for number, found in enumerate(other.receive()[0]):
        np.testing.assert_array_equal(found, float(number))
    del shared
    assert count_fds() == before


def test_pages_are_not_found_while_they_are_unmapped(monkeypatch):
    """Another thread may have a new array at their address before they are forgotten."""
    shared, unmap, found = share(np.ones(100_000)), pages._libc.munmap, []

    def look(address, size):
        found.append(pages.find_pages(memoryview((ctypes.c_ubyte * size).from_address(address))))
        return unmap(address, size)

    monkeypatch.setattr(pages._libc, "munmap", look)
    assert pages.find_pages(memoryview(shared).cast("B")) is not None
    del shared
    assert found == [None]


def test_threads_share_and_send_at_once():
    def exchange(seed):
        rng, (ours, theirs) = np.random.default_rng(seed), socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        one, other = Channel(ours), Channel(theirs)
        for _ in range(100):
            value, size = rng.random(), rng.integers(5_000, 100_000)
            shared = share({"a": np.full(size, value), "b": np.full(size // 3, value + 1.0)})
            assert one.send([shared["a"][100:], shared["b"], np.full(7_000, value + 2.0)])
            del shared
            for place, found in enumerate(other.receive()[0]):
                np.testing.assert_array_equal(found, value + place)
        one.close()
        other.close()

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(exchange, range(4)))
    finally:
        sys.setswitchinterval(before)


def test_small_objects_are_not_shared():
    small = np.ones(10)
    assert share(small) is small


def test_shared_objects_outlive_a_fork():
    """A forked process can pass on what its parent has shared."""
    shared, (read, write) = share(np.ones(100_000)), os.pipe()
    if (pid := os.fork()) == 0:
        try:
            package = Package.of(shared)
            os.write(write, b"%d" % (package.size < MIN_SHARED_BYTES and len(package.files) == 2))
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    assert os.read(read, 1) == b"1"
    os.close(read)
    os.close(write)


def test_mapped_messages_hold_no_descriptors(ends):
    one, other, _ = ends
    before = count_fds()
    kept = []
    for _ in range(100):
        assert one.send(arrays(100_000))
        kept.append(other.receive())
    assert count_fds() == before
    assert len(kept) == 100


def test_closed_ends_are_noticed(ends):
    one, other, _ = ends
    waiting = threading.Thread(target=other.receive)
    waiting.start()
    one.close()
    waiting.join()
    assert other.receive() is None
    assert not other.send("lost")
    assert not one.send("lost")
    assert one.receive() is None


def test_receiver_returns_when_its_own_end_is_closed(ends):
    _, other, _ = ends
    found = []
    waiting = threading.Thread(target=lambda: found.append(other.receive()))
    waiting.start()
    other.close()
    waiting.join()
    assert found == [None]


def test_full_socket_is_waited_for_only_within_the_limit(ends):
    one, other, _ = ends
    sent = 0
    while one.send(b"x" * 1000, wait=False):
        sent += 1
    assert sent > 10
    one.limit_wait(0.01)
    assert not one.send(b"x" * 1000)
    assert not one.send(arrays(1_000_000))
    for _ in range(sent):
        assert other.receive() == (b"x" * 1000, [])
    assert one.send("room again")
    assert other.receive() == ("room again", [])


def header(places, files):
    """Return the start of a message."""
    data = pickle.dumps(places, 5)
    return len(data).to_bytes(4, "little") + bytes([files]) + data


DAMAGED = {
    "noise": b"\xff" * 100,
    "a header alone": header([], 0),
    "an unfinished pickle": header([], 0) + pickle.dumps(list(range(100)))[:-5],
    "a class that does not exist": header([], 0) + b"cservice.nothing\nNothing\n.",
    "no file": header([(0, 0, 10)], 1),
    "a size of the header beyond the end": b"\xff\xff\xff\x7f\x00",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_messages_end_the_connection(ends, name, caplog):
    _, other, raw = ends
    before, (read, write) = count_fds(), os.pipe()
    socket.send_fds(raw, [DAMAGED[name]], [] if name == "no file" else [read])
    assert other.receive() is None
    assert "cannot be read" in caplog.text
    os.close(read)
    os.close(write)
    assert count_fds() == before


@pytest.mark.parametrize(
    "places",
    [[(0, 0, mmap.PAGESIZE + 1)], [(0, 0, 0)], [(0, 0, 10), (0, 5000, 10_000)], [(0, 0, -1)], [(1, 0, 10)], []],
)
def test_files_shorter_than_stated_are_not_read(ends, places, caplog):
    _, other, raw = ends
    before, file = count_fds(), os.memfd_create("short")
    os.truncate(file, mmap.PAGESIZE)
    socket.send_fds(raw, [header(places, 1)], [file])
    assert other.receive() is None
    assert "cannot be read" in caplog.text
    os.close(file)
    assert count_fds() == before


def test_more_descriptors_than_expected_are_closed(ends, caplog):
    _, other, raw = ends
    before, (read, write) = count_fds(), os.pipe()
    socket.send_fds(raw, [header([], 0) + pickle.dumps(1)], [read] * 50)
    assert other.receive() is None
    assert "larger than the limit" in caplog.text
    os.close(read)
    os.close(write)
    assert count_fds() == before
