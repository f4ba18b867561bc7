"""How a training happens: data, queue, pools, a trial."""
