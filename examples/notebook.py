# %% [markdown]
# # Slow features in a notebook
# Open this file as a notebook with Jupytext, or run its cells in an editor that knows `# %%`.

# %%
import numpy as np

import cdmisfa

t = np.arange(20_000) / 50
streams = {
    "arm": np.stack([np.sin(0.3 * t) + np.sin(11 * t), np.sin(11 * t)], axis=1),
    "noise": np.random.default_rng(0).standard_normal((len(t), 2)),
}
cdmisfa.Recording(streams)

# %% [markdown]
# The learner chooses by itself what it watches.

# %%
run = cdmisfa.learn(streams)
run

# %%
run.modules[0]

# %%
run.view(tab="Overview")
