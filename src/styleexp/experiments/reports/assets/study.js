(async function () {
  const study = JSON.parse(byId("study").textContent);
  const wanted = new URLSearchParams(location.hash.slice(1)); // study.html#seed=7&simulated
  const keep = `${study.schema} ${study.study}`;
  const sections = ["welcome", "rating", "thanks"], kinds = ["source", "style", "result"];
  const viewers = kinds.map((kind) => byId(`view-${kind}`));
  const files = new Map();
  let answers = null, place = 0, since = 0, asked = 0;

  // Mulberry32: the same order for the same seeds in every browser.
  function randomNumbers(seed) {
    return () => {
      seed = (seed + 0x6d2b79f5) | 0;
      let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
      t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
      return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
    };
  }
  function shuffled(count, seed) {
    const order = [...Array(count).keys()], random = randomNumbers(seed);
    for (let k = count - 1; k > 0; k--) {
      const other = Math.floor(random() * (k + 1));
      [order[k], order[other]] = [order[other], order[k]];
    }
    return order;
  }
  function fresh() {
    const [a, b, c] = crypto.getRandomValues(new Uint32Array(3));
    const orderSeed = wanted.has("seed") ? Number(wanted.get("seed")) | 0 : c | 0;
    return {
      schema: study.schema,
      study: study.study,
      title: study.title,
      participant: a.toString(16).padStart(8, "0") + b.toString(16).padStart(8, "0"),
      simulated: wanted.has("simulated"),
      study_seed: study.seed,
      order_seed: orderSeed,
      order: shuffled(study.pairs.length, Math.imul(study.seed + 1, 0x9e3779b1) ^ orderSeed)
        .map((index) => study.pairs[index].id),
      pairs: study.pairs.map(({ id, label }) => ({ id, label })),
      ratings: {},
      seconds: {},
    };
  }

  // A browser may forbid storage; the answers then live as long as the page.
  function store() { try { localStorage.setItem(keep, JSON.stringify(answers)); } catch { /* as said */ } }
  function stored() { try { return JSON.parse(localStorage.getItem(keep)); } catch { return null; } }

  const go = (name) => sections.forEach((each) => { byId(each).hidden = each !== name; });
  const spinning = () => byId("spin").getAttribute("aria-pressed") === "true";
  const current = () => study.pairs.find((pair) => pair.id === answers.order[place]);
  const rated = () => answers.order.filter((id) => id in answers.ratings).length;

  function spin(on) {
    byId("spin").setAttribute("aria-pressed", String(on));
    if (on) { link.release(); turnTogether(viewers, spinning); }
  }

  function noteTime() {
    const id = current().id;
    answers.seconds[id] = Math.round(10 * ((answers.seconds[id] ?? 0) + (performance.now() - since) / 1000)) / 10;
    since = performance.now();
  }

  async function ask() {
    go("rating");
    const pair = current(), turn = ++asked;
    delete byId("stage").dataset.pair;
    byId("progress").textContent = `Set ${place + 1} of ${study.pairs.length}`;
    for (const radio of document.querySelectorAll("#scale input"))
      radio.checked = answers.ratings[pair.id] === Number(radio.value);
    byId("next").disabled = !(pair.id in answers.ratings);
    byId("back").disabled = place === 0;
    byId("picture").hidden = !pair.style.picture;
    byId("view-style").hidden = Boolean(pair.style.picture);
    if (pair.style.picture) byId("picture").src = pair.style.picture;
    byId("viewer-state").textContent = "Loading the meshes …";
    try {
      for (const kind of kinds.filter((each) => pair[each].block)) {
        const block = pair[kind].block;
        if (!files.has(block)) files.set(block, await inflate(`glb-${block}`));
        await show(byId(`view-${kind}`), files.get(block), [SURFACE]);
        if (turn !== asked) return; // gone on meanwhile
      }
    } catch (error) {
      byId("viewer-state").textContent = `The meshes can't be shown (${error.message}).`;
      return;
    }
    byId("viewer-state").textContent = "";
    byId("stage").dataset.pair = pair.id;
    since = performance.now();
  }

  function rate(value) {
    answers.ratings[current().id] = value;
    byId("next").disabled = false;
    store();
  }

  function step(by) {
    if (by > 0 && byId("next").disabled) return;
    noteTime();
    store();
    place += by;
    if (place === study.pairs.length) go("thanks");
    else ask();
  }

  for (const radio of document.querySelectorAll("#scale input"))
    radio.addEventListener("change", () => rate(Number(radio.value)));
  document.addEventListener("keydown", (event) => {
    if (byId("rating").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
    const radio = document.querySelector(`#scale input[value="${event.key}"]`);
    if (radio) { radio.checked = true; rate(Number(radio.value)); }
    else if (event.key === "Enter" && event.target.tagName !== "BUTTON") step(1);
  });
  byId("next").addEventListener("click", () => step(1));
  byId("back").addEventListener("click", () => step(-1));
  byId("return").addEventListener("click", () => { place = study.pairs.length - 1; ask(); });
  byId("begin").addEventListener("click", () => { place = Math.min(rated(), study.pairs.length - 1); ask(); spin(!still); });
  byId("again").addEventListener("click", () => { answers = fresh(); store(); place = 0; ask(); spin(!still); });
  byId("spin").addEventListener("click", () => spin(byId("spin").getAttribute("aria-pressed") !== "true"));
  byId("save").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([JSON.stringify(answers, null, 2) + "\n"], { type: "application/json" }));
    link.download = `answers-${answers.participant}.json`;
    link.click();
    byId("saved").textContent = `Saved as ${link.download}, where your browser puts downloads.`;
  });
  for (const viewer of viewers) {
    viewer.addEventListener("pointerdown", () => spin(false));
    viewer.addEventListener("keydown", (event) => { if (event.key.startsWith("Arrow")) spin(false); });
  }

  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const link = linkCameras(viewers, () => true);
  const trouble = obstacle();
  if (trouble) { byId("viewer-state").textContent = `${trouble} Please open it in another one.`; return; }
  try {
    await startViewer();
  } catch {
    byId("viewer-state").textContent = "The 3D viewer can't be started.";
    return;
  }
  const before = stored();
  answers = before ?? fresh();
  if (before) {
    byId("begin").textContent = `Go on (${rated()} of ${study.pairs.length} rated)`;
    byId("again").hidden = false;
  }
  byId("simulated").hidden = !answers.simulated;
  byId("viewer-state").textContent = "";
  go("welcome");
})();
