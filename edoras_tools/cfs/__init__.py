"""Facts of cFE, OSAL and the lab apps as data. The doctor, the sweep and the emulator read the same ones."""
