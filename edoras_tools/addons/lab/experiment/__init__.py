"""Many runs of a system under several settings: what each setting loses, with how sure that is."""
