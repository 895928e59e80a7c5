"""Fault injection: which datagrams are dropped, delayed, duplicated or changed."""
