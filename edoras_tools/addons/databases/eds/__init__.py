"""Electronic data sheets: CCSDS 876.0 as cFE's sheets use it."""
