"""Where sources, decoders and sinks meet: each file is what one command does, without its command line."""
