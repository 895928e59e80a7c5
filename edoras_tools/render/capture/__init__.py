"""Views of captures: packets, routes, totals."""
