"""Electronic data sheets: CCSDS 876.0 as cFE's sheets use it, read as layouts of structs."""
