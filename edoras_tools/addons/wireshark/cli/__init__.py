"""``edoras wireshark``, and the program that Wireshark itself runs."""
