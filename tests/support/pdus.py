"""CFDP PDUs with IDs of one byte, from entity 1 to entity 2."""

from binascii import crc_hqx

from edoras_tools.addons.cfdp import link as cfdp
from edoras_tools.addons.cfdp.link import Directive


def pdu(kind, body=b"", number=7, *, back=False, large=False, acknowledged=True, **values):
    """Write a PDU: the fields of its layout, then what follows them."""
    field = cfdp.PDU_LAYOUTS[large][kind].emit(values) + body
    field = field if kind == Directive.FILE_DATA else bytes([kind]) + field
    head = {
        "version": 1,
        "pdu_type": kind == Directive.FILE_DATA,
        "direction": back,
        "transmission_mode": not acknowledged,
        "large_file_flag": large,
        "pdu_data_field_length": len(field),
    }
    return cfdp.PDU_HEADER.emit(head) + bytes([1, number, 2]) + field


def piece(offset, data, number=7, **how):
    """Write a piece of a file."""
    return pdu(Directive.FILE_DATA, data, number, offset=offset, **how)


def metadata(size, name=b"x", number=7, **how):
    """Write Metadata, with one name at both ends."""
    text = bytes([len(name)]) + name
    return pdu(Directive.METADATA, text + text, number, file_size=size, **how)


def eof(content, number=7, *, checksum=None, **how):
    """Write EOF, with the modular checksum unless another is given."""
    total = cfdp.modular_checksum(content, 0) if checksum is None else checksum
    return pdu(Directive.EOF, number=number, file_size=len(content), file_checksum=total, **how)


def nak(*missing, number=7):
    """Write a NAK of parts that are missing: first byte, and one past the last."""
    body = b"".join(end.to_bytes(4, "big") for pair in missing for end in pair)
    return pdu(Directive.NAK, body, number, back=True)


def finished(condition=0, number=7):
    """Write Finished; a condition means that the file is not there."""
    values = {
        "condition_code": condition,
        "delivery_code": bool(condition),
        "file_status": 0 if condition else 2,
    }
    return pdu(Directive.FINISHED, number=number, back=True, **values)


def with_crc(made):
    """Return a PDU with a CRC-16 at its end (727.0-B 4.1): the flag set, the length field 2 more."""
    size = int.from_bytes(made[1:3], "big") + 2
    flagged = bytes([made[0] | 2]) + size.to_bytes(2, "big") + made[3:]
    return flagged + crc_hqx(flagged, 0xFFFF).to_bytes(2, "big")
