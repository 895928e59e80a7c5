"""Messages that other links carry: files of CFDP, events of F Prime, bodies of RACS2, samples of DDS."""
