# %% [markdown]
# # What the renderer changes (Sec. 3.3.1; no figure)
#
# `styleexp +experiment=renderer_ablation`: every renderer with several seeds. The paper names one
# differentiable renderer; the question is whether the choice matters more than chance does.

# %% tags=["parameters"]
folder = "outputs/renderer_ablation"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
from IPython.display import Markdown

from styleexp.experiments.reports import notebook as nb

runs = nb.runs(folder, "renderer_ablation", "backend_agreement")
runs["renderer"] = runs.get("axis.renderer", "soft_raster")
Markdown(nb.caution(runs))

# %% [markdown]
# ## The figure

# %%
nb.pictures(runs, "renderer", "seed")

# %% [markdown]
# ## The numbers

# %%
shown = nb.table(runs, ["style_distance", "relief_distance", "relief_rms", "silhouette_iou"])
nb.save(shown, tables, "backends")
nb.show(shown)

# %%
nb.bars(runs, "renderer", ["style_distance", "relief_rms", "seconds"])

# %% [markdown]
# ## Is it more than chance?
#
# The spread of the renderers' means beside the spread of the seeds within a renderer.

# %%
finished = runs[runs["status"] == "done"]


def spread(metric):
    column = f"metric.{metric}"
    if column not in finished or finished[column].notna().sum() < 2:
        return float("nan"), float("nan")
    by_renderer = finished.groupby("renderer")[column]
    return by_renderer.mean().std(), by_renderer.std().mean()


nb.claims(
    *(
        nb.smaller(
            f"(not in the paper) the renderer matters less than the seed for {metric}",
            ("spread of renderers", spread(metric)[0]), ("spread of seeds", spread(metric)[1]), metric,
        )
        for metric in ("style_distance", "relief_rms", "silhouette_iou")
    )
)  # fmt: skip
