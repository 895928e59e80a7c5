"""What an eye would see in a picture or page, as figures."""


def contrast(ground, ink):
    """Return the contrast of two colours (red, green and blue to 255) as WCAG 2.2 defines it: 1 to 21."""
    low, high = sorted(map(_luminance, (ground, ink)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour):
    parts = [part / 255 for part in colour]
    red, green, blue = (
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
