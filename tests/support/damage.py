"""Recordings damaged on purpose in eight ways, and a plain scan to compare a recovery with."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from io import BytesIO
from random import Random

import zstandard
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.recover import repair

SEED = "damage 13"


# Each changes ``data``, and returns whether it put ``other`` behind it.


def flipped_bit(data, other, random):
    place = random.randrange(len(data))
    data[place] ^= 1 << random.randrange(8)


def wrong_byte(data, other, random):
    place = random.randrange(len(data))
    data[place] = (data[place] + random.randrange(1, 256)) % 256


def inserted(data, other, random):
    place = random.randrange(len(data))
    data[place:place] = random.randbytes(random.choice([1, 7, 100, 5000]))


def removed(data, other, random):
    place = random.randrange(len(data))
    del data[place : place + random.choice([1, 7, 100, 5000])]


def zeroed(data, other, random):
    place = random.randrange(len(data))
    size = min(random.choice([16, 512, 4096, 20_000]), len(data) - place)
    data[place : place + size] = bytes(size)


def truncated(data, other, random):
    del data[random.randrange(200, len(data)) :]


def joined(data, other, random):
    data += other
    return True


def appended(data, other, random):
    """Cut off, then another file behind it, whole or with its start gone."""
    del data[random.randrange(200, len(data)) :]
    data += random.choice([other, other[random.randrange(300) :]])
    return True


def cut_and_rubbish(data, other, random):
    """Cut off, then bytes that mean nothing."""
    del data[random.randrange(200, len(data)) :]
    data += random.randbytes(random.choice([10, 3000]))


WAYS = {
    "flipped bit": flipped_bit,
    "wrong byte": wrong_byte,
    "inserted bytes": inserted,
    "removed bytes": removed,
    "zeroed block": zeroed,
    "truncated": truncated,
    "two joined": joined,
    "cut, appended": lambda *given: (given[2].choice([appended, appended, cut_and_rubbish]))(*given),
}


def damaged(wholes, count, seed=SEED):
    """Yield so many damaged files: the way, the bytes, and the messages of what they were made of."""
    inside = {whole: messages(whole) for whole in wholes}
    for number in range(count):
        way = list(WAYS)[number % len(WAYS)]
        random = Random(f"{seed} {number}")
        first, second = random.choice(wholes), random.choice(wholes)
        data = bytearray(first)
        two = WAYS[way](data, second, random)
        yield way, bytes(data), inside[first] + inside[second] if two else inside[first]


def messages(data):
    """What a whole file holds, read by the mcap library: messages by topic, times, sequence and bytes."""
    channels, found = {}, Counter()
    for record in StreamReader(BytesIO(data), validate_crcs=True).records:
        if type(record).__name__ == "Channel":
            channels[record.id] = record.topic
        elif type(record).__name__ == "Message":
            found[(channels[record.channel_id], *_told(record))] += 1
    return found


def indexed(path):
    """How many messages the mcap library finds by the index of a file; every checksum must be right."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())


def plain_scan(data):
    """Find the messages, without topics, of every chunk anywhere in a file whose CRC is right."""
    found = Counter()
    place = -1
    while 0 <= (place := data.find(b"\6", place + 1)) < len(data) - 49:
        length, _, _, size, crc, named = struct.unpack_from("<QQQQII", data, place + 1)
        if not crc or named > 8 or length > len(data) - place - 9:
            continue
        name = data[place + 41 : place + 41 + named]
        packed = data[place + 49 + named : place + 9 + length]
        try:
            zipped = name == b"zstd"
            raw = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size) if zipped else packed
        except zstandard.ZstdError:
            continue
        if zlib.crc32(raw) == crc:
            found += _walked(raw)
    return found


def _walked(raw):
    found, place = Counter(), 0
    while place < len(raw):
        opcode, length = struct.unpack_from("<BQ", raw, place)
        if opcode == 5:
            _, sequence, log, publish = struct.unpack_from("<HIQQ", raw, place + 9)
            found[log, publish, sequence, raw[place + 31 : place + 9 + length]] += 1
        place += 9 + length
    return found


def _told(message):
    return message.log_time, message.publish_time, message.sequence, message.data


def without_topics(found):
    """The same messages whatever their topic."""
    plain = Counter()
    for key, count in found.items():
        plain[key[1:]] += count
    return plain


def tried(command, wholes, count, folder, seed=SEED):
    """Damage files and recover them; return a row of each way.

    Args:
        command: given source and target, returns the exit code, and how many messages it says were kept.
        wholes: the bytes of sound files.
        count: how many files to damage.
        folder: for the files.

    Returns:
        By way: files, messages before, in sound chunks, kept; files where a plain scan finds more,
        where a message was altered or foreign, where the exit code is wrong; files written, and those of them
        in which a reader that goes by their index sees another number of messages than the report says.
    """
    rows = {way: Counter() for way in WAYS}
    source, target = folder / "damaged.mcap", folder / "recovered.mcap"
    for number, (way, data, before) in enumerate(damaged(wholes, count, seed)):
        source.write_bytes(data)
        target.unlink(missing_ok=True)
        code, said = command(source, target)
        kept = messages(target.read_bytes()) if target.exists() else before if code == 0 else Counter()
        scanned = plain_scan(data)
        row = rows[way]
        row["files"] += 1
        row["before"] += before.total()
        row["in sound chunks"] += (scanned & without_topics(before)).total()
        row["kept"] += kept.total()
        row["written"] += target.exists()
        wrong = {
            "unlike its index": target.exists() and indexed(target) != said,
            "less than a scan": bool((scanned & without_topics(before)) - without_topics(kept)),
            "altered": altered(kept, before),
            "exit code": not right_code(code, way, before, kept, target.exists()),
        }
        for what, is_so in wrong.items():
            row[what] += is_so
            if is_so:
                print(f"{way} {number}: {what}: exit code {code}, kept {kept.total()} of {before.total()}")
    return rows


def altered(kept, before):
    """Tell whether a message is not as it was; one of a channel whose description is lost has no topic."""
    unknown = Counter({item: count for item, count in kept.items() if item[0].startswith("/unknown/")})
    return bool((kept - unknown) - before or without_topics(unknown) - without_topics(before))


def right_code(code, way, before, kept, written):
    """Tell whether an exit code is right: 3 where anything is lost, 1 where no message is left, else 0.

    Where all messages are kept something else may be lost: an attachment, or the end, so that nobody knows.
    """
    if not written and code:
        return code == 1 and not kept
    return code == 3 if before - kept else code in {0, 3}


def by_library(source, target):
    """Recover; return what the command ends with, and how many messages it says it kept."""
    try:
        report = repair(source, target)
    except CaptureError:
        return 1, 0
    assert repair(source, None) == report
    return 3 if report.lost else 0, sum(report.messages.values())
