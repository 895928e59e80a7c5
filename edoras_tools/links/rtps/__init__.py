"""DDS over UDP (RTPS): the link, what participants announce, and the reader, loaded with the first."""
