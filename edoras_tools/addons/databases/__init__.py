"""Descriptions of packets in XML, read as layouts of structs: electronic data sheets, and XTCE."""
