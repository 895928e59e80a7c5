"""What must hold of each row of a balance."""

from edoras_tools.diagnosis.ledger import ENDINGS


def adds_up(row):
    """Tell whether what came, or was doubled, is what became of it, and nothing is negative."""
    rest = [getattr(row, name) for name in ENDINGS[1:]]
    figures = row.came, row.out, row.duplicated, *row.lost.values(), *rest
    return min(figures) >= 0 and row.came + row.duplicated == row.out + row.all_lost + sum(rest)


def wrong_rows(rows):
    """Return the rows that do not add up."""
    return [row for row in rows if not adds_up(row)]
