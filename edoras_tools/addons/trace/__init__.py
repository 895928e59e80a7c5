"""The way of one message, hop by hop, a topic in the rounds of its queue, and a topic's rate at each hop."""
