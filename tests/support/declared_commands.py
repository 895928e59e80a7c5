"""Commands with arguments, as they are typed and as public C headers declare them."""

import struct

DECLARED = [
    # What is typed; MsgId, code and the C declaration of what follows the header: format, field, value.
    ("es-restart restart_type=processor", 0x1806, 2, [("H", 1)]),
    ("es-start-app application=SCH entry_point=SCH_Main file_name=/cf/sch.so stack_size=8192 priority=70",
     0x1806, 4, [("20s", "SCH"), ("20s", "SCH_Main"), ("64s", "/cf/sch.so"), ("I", 8192), ("B", 0),
      ("B", 0), ("H", 70)]),
    ("es-start-app SCH SCH_Main file_name=/cf/sch.so exception_action=restart_all tail=4",
     0x1806, 4, [("20s", "SCH"), ("20s", "SCH_Main"), ("64s", "/cf/sch.so"), ("I", 65536), ("B", 1),
      ("B", 0), ("H", 50), ("I", 0)]),
    ("es-stop-app application=TO_LAB_APP", 0x1806, 5, [("20s", "TO_LAB_APP")]),
    ("es-restart-app application=SBN", 0x1806, 6, [("20s", "SBN")]),
    ("es-reload-app application=SBN file_name=/cf/sbn.so",
     0x1806, 7, [("20s", "SBN"), ("64s", "/cf/sbn.so")]),
    ("es-query-one CFE_SB", 0x1806, 8, [("20s", "CFE_SB")]),
    ("es-query-all file_name=/ram/apps.log", 0x1806, 9, [("64s", "/ram/apps.log")]),
    ("es-write-sys-log file_name=/ram/sys.log", 0x1806, 11, [("64s", "/ram/sys.log")]),
    ("es-start-perf-data trigger_mode=end", 0x1806, 14, [("I", 2)]),
    ("es-set-perf-filter-mask mask_number=1 mask=0xdeadbeef", 0x1806, 16, [("I", 1), ("I", 0xDEADBEEF)]),
    ("es-over-write-sys-log mode=discard", 0x1806, 18, [("I", 1)]),
    ("es-set-max-pr-count max_resets=3", 0x1806, 20, [("H", 3)]),
    ("es-delete-cds cds_name=APP.STORE", 0x1806, 21, [("40s", "APP.STORE")]),
    ("es-send-mem-pool-stats application=CFE_SB pool_handle=0x10001",
     0x1806, 22, [("20s", "CFE_SB"), ("I", 0x10001)]),
    ("evs-enable-event-type event_types=0x0f", 0x1801, 2, [("B", 15), ("B", 0)]),
    ("evs-set-event-format-mode format=long", 0x1801, 4, [("B", 1), ("B", 0)]),
    ("evs-disable-app-event-type CFE_ES 1", 0x1801, 6, [("20s", "CFE_ES"), ("B", 1), ("B", 0)]),
    ("evs-reset-app-counter CFE_ES", 0x1801, 9, [("20s", "CFE_ES")]),
    ("evs-set-filter application=CFE_SB event_id=17 mask=0xfff0",
     0x1801, 10, [("20s", "CFE_SB"), ("H", 17), ("H", 0xFFF0)]),
    ("evs-disable-ports ports=2", 0x1801, 12, [("B", 2), ("B", 0)]),
    ("evs-delete-event-filter CFE_SB 17", 0x1801, 16, [("20s", "CFE_SB"), ("H", 17)]),
    ("evs-write-log-data-file file_name=/ram/events.log", 0x1801, 18, [("64s", "/ram/events.log")]),
    ("evs-set-log-mode mode=discard", 0x1801, 19, [("B", 1), ("B", 0)]),
    ("sb-write-pipe-info file_name=/ram/pipes.dat", 0x1803, 7, [("64s", "/ram/pipes.dat")]),
    ("sb-disable-route msg_id=0x0827 pipe_id=0x20003", 0x1803, 5, [("I", 0x827), ("I", 0x20003), ("I", 0)]),
    ("tbl-load file_name=/cf/sch.tbl", 0x1804, 2, [("64s", "/cf/sch.tbl")]),
    ("tbl-dump buffer=active table_name=SCH.DEF file_name=/ram/x.tbl",
     0x1804, 3, [("H", 1), ("40s", "SCH.DEF"), ("64s", "/ram/x.tbl")]),
    ("tbl-validate buffer=inactive table_name=SCH.DEF", 0x1804, 4, [("H", 0), ("40s", "SCH.DEF")]),
    ("tbl-activate table_name=SCH.DEF", 0x1804, 5, [("40s", "SCH.DEF")]),
    ("time-set-source source=external", 0x1805, 3, [("H", 2)]),
    ("time-set-state state=invalid", 0x1805, 4, [("h", -1)]),
    ("time-add-delay seconds=1 microseconds=999999", 0x1805, 5, [("I", 1), ("I", 999_999)]),
    ("time-set-leap-seconds leap_seconds=-37", 0x1805, 10, [("h", -37)]),
    ("time-add-one-hz seconds=0 subseconds=4294967295", 0x1805, 13, [("I", 0), ("I", 0xFFFFFFFF)]),
    ("time-set-signal signal=redundant", 0x1805, 15, [("H", 2)]),
    ("to-add-pkt stream=0x0827 limit=9 reliability=high",
     0x1880, 2, [("I", 0x827), ("B", 0), ("B", 1), ("B", 9), ("B", 0)]),
    ("to-remove-pkt stream=SB_HK", 0x1880, 4, [("I", 0x803)]),
    ("to-enable-output address=10.1.2.3", 0x1880, 6, [("16s", "10.1.2.3")]),
    ("sch-disable slot=12 entry=3", 0x1895, 3, [("H", 12), ("H", 3)]),
    ("sch-enable-group groups=0x03000001", 0x1895, 4, [("I", 0x03000001)]),
    ("cf-tx-file cfdp_class=1 channel=1 destination=23 source_name=/cf/a destination_name=/b", 0x18B3, 2,
     [("B", 1), ("B", 1), ("B", 1), ("B", 0), ("I", 23), ("64s", "/cf/a"), ("64s", "/b")]),
    ("cf-cancel sequence=7 entity_id=23 channel=0",
     0x18B3, 8, [("I", 7), ("I", 23), ("B", 0), ("B", 0), ("H", 0)]),
    ("cf-set-param value=30 parameter=ack_timer_s", 0x18B3, 10, [("I", 30), ("B", 2), ("B", 0), ("H", 0)]),
    ("ds-set-filter-parms stream=0x0827 filter_index=1 pass_count=2 of=5 offset=1", 0x18BB, 5,
     [("I", 0x827), ("H", 1), ("H", 2), ("H", 5), ("H", 1)]),
    ("ds-set-dest-ext file_index=3 extension=.dat", 0x18BB, 10, [("H", 3), ("H", 0), ("8s", ".dat")]),
    ("sbn-hk-peer net=0 peer=2", 0x18FA, 12, [("B", 0), ("B", 2)]),
]  # fmt: skip
"""On a little-endian cFS."""
KINDS = {"s": "STRING", "h": "INT", "b": "INT"}


def target_text(target):
    """Return the declarations as a target's file of COSMOS, which encodes by itself."""
    lines = []
    for number, (_, msg_id, code, declared) in enumerate(DECLARED):
        size = sum(struct.calcsize(f"<{form}") for form, _ in declared)
        lines.append(f'COMMAND {target} C{number} LITTLE_ENDIAN "x"')
        lines.append(f'  ID_PARAMETER MID 0 16 UINT 0 65535 {msg_id} "x" BIG_ENDIAN')
        lines.append('  PARAMETER SEQUENCE 16 16 UINT 0 65535 0 "x" BIG_ENDIAN')
        lines.append(f'  PARAMETER LENGTH 32 16 UINT 0 65535 {size + 1} "x" BIG_ENDIAN')
        lines.append(f'  ID_PARAMETER CODE 48 8 UINT 0 255 {code} "x"\n  PARAMETER SUM 56 8 UINT 0 255 0 "x"')
        at = 64
        for place, (form, _) in enumerate(declared):
            bits, kind = 8 * struct.calcsize(f"<{form}"), KINDS.get(form[-1], "UINT")
            room = '"x"' if kind == "STRING" else "MIN MAX 0"
            lines.append(f'  PARAMETER P{place} {at} {bits} {kind} {room} "x"')
            at += bits
    return "\n".join(lines)
