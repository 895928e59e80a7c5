"""CFDP: file delivery over UDP and in space packets: read, recorded, judged, and files taken out."""
