"""Files that cFE wrote: event logs and stored packets as captures, and the contents of others."""
