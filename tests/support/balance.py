"""What must hold of each row of a balance, and the sums of a line's rows."""

from collections import Counter

from edoras_tools.diagnosis.accounting.closed import UDP_PORT
from edoras_tools.diagnosis.accounting.losses import BUS
from edoras_tools.diagnosis.evidence.relays import PROXY_HOP
from edoras_tools.diagnosis.ledger import CI_HOP, ENDINGS, PEER


def adds_up(row):
    """Tell whether what came, or was doubled, is what became of it, and nothing is negative."""
    rest = [getattr(row, name) for name in ENDINGS[1:]]
    figures = row.came, row.out, row.duplicated, *row.lost.values(), *rest
    return min(figures) >= 0 and row.came + row.duplicated == row.out + row.all_lost + sum(rest)


def wrong_rows(rows):
    """Return the rows that do not add up."""
    return [row for row in rows if not adds_up(row)]


def ended(line):
    """Return how many messages of a headline ended in each way; all but those that arrived."""
    rest = {name: sum(getattr(row, name) for row in line.rows) for name in ENDINGS[1:]}
    return Counter({"lost": sum(row.all_lost for row in line.rows), **rest})


def arrived(line):
    """Return how many messages of a headline left the last hop; None if the capture does not show that."""
    behind = PEER, UDP_PORT  # hops that follow the last captured datagram
    last = next(row.hop for row in reversed(line.rows) if not row.hop.startswith(behind))
    if last in {PROXY_HOP, CI_HOP, BUS}:
        return None
    left = sum(row.out for row in line.rows if row.hop == last) - sum(row.duplicated for row in line.rows)
    return left - sum(row.came - row.out for row in line.rows if row.hop.startswith(behind))
