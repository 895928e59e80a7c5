"""RTPS, the wire protocol of DDS: headers, submessages, and the parameter lists of discovery.

DDSI-RTPS 2.5 (OMG formal/2022-04-01).
"""
