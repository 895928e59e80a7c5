"""Link layers to payloads and back: frames, IP, fragments."""
