"""What self-contained pages are made of: charts as inline SVG, cards, style."""
