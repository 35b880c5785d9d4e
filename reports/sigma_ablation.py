# %% [markdown]
# # The standard deviation σ of the Fourier features (Fig. 7)
#
# The paper compares σ = 1, 5 and 10. Here: `styleexp +experiment=sigma_ablation`. How fine the relief is,
# is measured as its slope over its height: the root mean square change of the displacement along an edge,
# by the edge's length and by the root mean square displacement.

# %% tags=["parameters"]
folder = "outputs/sigma_ablation"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
from IPython.display import Markdown

from styleexp.experiments.reports import notebook as nb
from styleexp.experiments.reports.notebook import slope

runs = nb.runs(folder, "sigma_ablation")
runs["σ"] = runs["axis.field.sigma"].astype(float)
runs["slope"] = [slope(path) for path in runs["path"]]
Markdown(nb.caution(runs))

# %% [markdown]
# ## The figure

# %%
nb.pictures(runs, "σ")

# %% [markdown]
# ## The numbers

# %%
if "metric.relief_rms" in runs:
    runs["fineness"] = runs["slope"] / runs["metric.relief_rms"].where(
        runs["metric.relief_rms"] > 0
    )
shown = nb.table(runs, ["style_distance", "relief_rms", "silhouette_iou", "craft"])
if "fineness" in runs:
    shown["fineness"] = runs["fineness"]
nb.save(shown, tables, "sigma_ablation")
nb.show(shown)

# %%
nb.bars(runs, "σ", ["relief_rms", "fineness", "style_distance"])

# %% [markdown]
# ## What the paper says of it

# %%
values = sorted(runs["σ"].unique())
low, high, chosen = values[0], values[-1], min(values, key=lambda value: abs(value - 5))


def of(metric, sigma):
    return f"σ = {sigma:g}", nb.mean(runs, metric, σ=sigma)


nb.claims(
    nb.smaller(
        "a larger σ makes the style more pronounced",
        of("relief_rms", low), of("relief_rms", high), "RMS height of the relief, in radii",
    ),
    nb.smaller(
        "a larger σ gives details of higher frequency",
        of("fineness", low), of("fineness", high), "slope over height",
    ),
    nb.smaller(
        "small values of σ have minimal effect",
        of("relief_rms", low), ("half of the largest σ's", nb.mean(runs, "relief_rms", σ=high) / 2),
        "RMS height of the relief, in radii",
    ),
    nb.smaller(
        "σ = 5 gives a distinct style, more so than the smallest",
        of("style_distance", chosen), of("style_distance", low), "style distance",
    ),
)  # fmt: skip
