"""Tables beyond one recording in memory: folders of recordings, lazy tables, Hive folders, and traces."""
