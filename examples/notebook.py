# %% [markdown]
# # Slow features in a notebook
# Open this file as a notebook with Jupytext, or run its cells in an editor that supports `# %%`.
#
# Two streams of numbers: `arm` mixes a slow and a fast oscillation, `noise` is random.

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
# Learn from both streams. The learner finds the slow oscillation of `arm` and rejects `noise`.

# %%
run = cdmisfa.learn(streams)
run

# %% [markdown]
# The module that was saved, and the run in the Rerun viewer.

# %%
run.modules[0]

# %%
run.view(tab="Overview")
