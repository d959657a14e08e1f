"""Train the behavior networks on simulated drives: cloning, then DAgger (paper, Sec. III-IV)."""
