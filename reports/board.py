# %% [markdown]
# # The sixteen pairs of the user study (Fig. 9)
#
# `styleexp +experiment=board`: our sixteen pairs, as the paper's can't be had. Ratings are there when people
# took part: `styleexp-report study FOLDER`, and `styleexp-report study --analyse answers/*.json --out FOLDER`.

# %% tags=["parameters"]
folder = "outputs/board"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
import json
from pathlib import Path

from IPython.display import Image, Markdown

from styleexp.experiments.reports import notebook as nb

runs = nb.runs(folder, "board")
Markdown(nb.caution(runs))

# %% [markdown]
# ## The pairs

# %%
nb.triples(runs)

# %% [markdown]
# ## The numbers

# %%
shown = nb.table(
    runs, ["style_distance", "relief_distance", "relief_rms", "silhouette_iou", "craft"]
)
nb.save(shown, tables, "board")
nb.show(shown)

# %% [markdown]
# ## The ratings

# %%
found = sorted(Path(folder).rglob("study.json"))
study = json.loads(found[0].read_text()) if found else None
if study is None:
    shown = Markdown("Nobody has rated these results yet: there is no `study.json`.")
elif study["simulated_participants"]:
    shown = Markdown(
        f"**{study['simulated_participants']} of {study['participants']} participants are simulated: "
        "a program gave these ratings.**"
    )
else:
    shown = Markdown(f"{study['participants']} participants.")
shown

# %%
Image(found[0].with_name("fig9.png").read_bytes()) if found else None

# %% [markdown]
# ## What the paper says of it

# %%
real = study is not None and not study["simulated_participants"]
told = "no ratings by people"
if real:
    told = f"{study['pairs_above_3']} of {study['pairs']} above 3, {study['pairs_above_4']} above 4"
nb.claims(
    nb.Claim("all pairs are rated above 3", told,
             study["pairs_above_3"] == study["pairs"] if real else None),
    nb.Claim("most pairs are rated above 4", told,
             study["pairs_above_4"] > study["pairs"] / 2 if real else None),
)  # fmt: skip
