(async function () {
  const on = (id) => byId(id)?.getAttribute("aria-pressed") === "true";
  const press = (id, state) => byId(id)?.setAttribute("aria-pressed", String(state));
  const state = byId("viewer-state"), stage = byId("stage");

  byId("copy")?.addEventListener("click", async () => {
    getSelection().selectAllChildren(byId("command"));
    try {
      await navigator.clipboard.writeText(byId("command").textContent);
      byId("copy").textContent = "Copied";
    } catch {
      byId("copy").textContent = "Selected";
    }
  });
  if (!stage) return;

  const viewers = [...stage.querySelectorAll("model-viewer")];
  const keys = viewers.map((viewer) => viewer.id.slice("view-".length));
  const trouble = keys.length ? obstacle() : null;
  if (trouble) {
    state.textContent = `${trouble} The still pictures below show them.`;
    return;
  }
  const files = {};
  async function refresh() {
    state.hidden = false;
    try {
      await Promise.all(keys.map(async (key) => {
        files[key] ??= await inflate(`glb-${key}`);
        const surface = key.startsWith("result") && on("heat") ? HEAT : SURFACE;
        await show(byId(`view-${key}`), files[key], on("wire") ? [surface, EDGES] : [surface]);
      }));
      state.hidden = true;
      stage.dataset.shown = String(Number(stage.dataset.shown || 0) + 1);
    } catch (error) {
      state.textContent = `The meshes can't be shown (${error.message}).`;
    }
  }

  const link = linkCameras(viewers, () => on("link"));
  const toggles = {
    heat() { byId("legend").hidden = !on("heat"); refresh(); },
    wire: refresh,
    compare() {
      stage.classList.toggle("compare", on("compare"));
      byId("cut-label").hidden = !on("compare");
      if (!on("compare")) return;
      const result = byId("view-result"), orbit = result.getCameraOrbit().toString();
      aim(byId("view-source"), orbit, result.getCameraTarget().toString(), `${result.getFieldOfView()}deg`);
      press("link", true);
    },
    link() {},
    spin() { if (on("spin")) { link.release(); turnTogether(viewers, () => on("spin")); } },
  };
  for (const [id, act] of Object.entries(toggles))
    byId(id)?.addEventListener("click", () => { press(id, !on(id)); act(); });
  byId("home").addEventListener("click", () => {
    press("spin", false);
    link.release();
    for (const viewer of viewers) aim(viewer, HOME.orbit, HOME.target, HOME.field);
  });
  byId("cut")?.addEventListener("input", () => stage.style.setProperty("--cut", `${byId("cut").value}%`));
  for (const viewer of viewers) {
    viewer.addEventListener("pointerdown", () => press("spin", false));
    viewer.addEventListener("keydown", (event) => {
      if (event.key.startsWith("Arrow")) press("spin", false);
    });
  }

  try {
    await startViewer();
  } catch {
    state.textContent = "The 3D viewer can't be started. The still pictures below show the meshes.";
    return;
  }
  await refresh();
})();
