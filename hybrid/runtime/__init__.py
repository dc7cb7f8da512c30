"""The process itself: threads, memory, compiled loops, interrupts, timings, and what differs between systems."""
