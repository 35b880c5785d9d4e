(async function () {
  const RANGES = ["strength", "scale", "rotation", "falloff"];
  const root = byId("studio"), shown = {};
  let state = null, result = null, queue = {}, timer = null, gone = false;

  async function ask(path, options) {
    const answer = await fetch(path, options);
    const found = await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Error(found.error || `the studio answered ${answer.status}`);
    return found;
  }
  const post = (path, given = {}) =>
    ask(path, { method: "POST", body: JSON.stringify(given), headers: { "Content-Type": "application/json" } });
  function complain(message) {
    byId("error").textContent = message;
    byId("error").hidden = !message;
  }
  async function attempt(act) {
    complain("");
    try { return await act(); } catch (error) { if (state) update(); complain(error.message); }
  }

  // ---------------------------------------------------------------- controls to settings
  const toSetting = { scale: (x) => Number((2 ** x).toFixed(3)) }, toControl = { scale: Math.log2 };
  function change(name, value) {
    queue[name] = value;
    clearTimeout(timer);
    timer = setTimeout(() => {
      const given = queue;
      queue = {};
      timer = null;
      attempt(() => post("settings", given));
    }, 250);
  }
  const label = (name, value) => (name === "rotation" ? `${value}°` : `${value}`);
  for (const name of RANGES)
    byId(name).addEventListener("input", () => {
      const value = (toSetting[name] || Number)(Number(byId(name).value));
      document.querySelector(`output[for=${name}]`).value = label(name, value);
      change(name, value);
    });
  for (const name of ["direction", "mask"]) byId(name).addEventListener("change", () => change(name, byId(name).value));
  byId("invert").addEventListener("change", () => change("invert", byId("invert").checked));
  byId("steps").addEventListener("change", () => change("steps", Number(byId("steps").value)));
  byId("again").addEventListener("click", () => change("seed", state.settings.seed + 1));
  byId("where").addEventListener("change", () => {
    const value = byId("where").value;
    byId("mask-label").hidden = value !== "own";
    byId("brush").hidden = !BRUSHES.has(value);
    if (BRUSHES.has(value)) paint(true);
    else if (value === "own") byId("mask").focus();
    else change("mask", value);
    if (!BRUSHES.has(value)) paint(false);
  });
  byId("learn").addEventListener("click", () => attempt(() => post(learning() ? "stop" : "learn")));
  const learning = () => /learning/.test(state.stage);

  // ---------------------------------------------------------------- files
  const MAIN = { source: /\.(obj|ply|stl|off|glb|gltf)$/i, style: /\.(obj|ply|stl|off|glb|gltf|png|jpe?g|webp|tiff?|bmp|gif|avif|jp2)$/i };
  async function take(kind, files) {
    // What lies beside a mesh goes first; of several files a mesh is meant, not its textures.
    const of = (pattern) => files.find((file) => pattern.test(file.name));
    const main = of(MAIN.source) || of(MAIN[kind]) || files[0];
    if (!main) return;
    await attempt(async () => {
      for (const file of [...files.filter((each) => each !== main), main]) {
        byId("stage-line").textContent = `reading ${file.name} …`;
        const place = file === main ? kind : "beside";
        await ask(`files/${place}/${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
      }
    });
  }
  for (const kind of ["source", "style"]) {
    const drop = byId(`drop-${kind}`);
    for (const over of ["dragenter", "dragover"])
      drop.addEventListener(over, (event) => { event.preventDefault(); drop.classList.add("over"); });
    drop.addEventListener("dragleave", () => drop.classList.remove("over"));
    drop.addEventListener("drop", (event) => {
      event.preventDefault();
      drop.classList.remove("over");
      take(kind, [...event.dataTransfer.files]);
    });
    byId(`file-${kind}`).addEventListener("change", (event) => take(kind, [...event.target.files]));
    byId(`known-${kind}`).addEventListener("change", (event) => {
      if (event.target.value) change(kind, event.target.value);
      event.target.value = "";
    });
  }
  // A file dropped beside its place must not replace the page.
  for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => event.preventDefault());

  // ---------------------------------------------------------------- brush
  // Its strokes are balls in the source's coordinates, as style.mask takes them.
  const BRUSHES = new Map([["not:near", "not where I paint"], ["near", "only where I paint"]]);
  const MOST_BALLS = 120;
  const painted = (mask) => {
    const [, kind, balls] = mask.match(/^((?:not:)?near):(\S+)$/) || [];
    return { kind, balls: balls ? balls.split("+") : [] };
  };
  const strokes = byId("strokes");
  const before = [];  // the masks before each stroke
  let stroke = null;
  function paint(on) {
    byId("paint").setAttribute("aria-pressed", String(on));
    strokes.hidden = !on;
    if (result) show(byId("view-result"), result, nodes());
  }
  // While one paints, the mask is seen.
  const nodes = () => [!strokes.hidden && state.result?.masked ? HEAT : SURFACE];
  function touch(event) {
    const viewer = byId("view-result"), box = strokes.getBoundingClientRect();
    const hit = viewer.positionAndNormalFromPoint(event.clientX, event.clientY);
    if (!hit || !state.result) return;
    const { center, scale } = state.result, size = Number(byId("brush-size").value);
    const at = ["x", "y", "z"].map((axis) => hit.position[axis]);
    const far = stroke.every((each) => Math.hypot(...each.at.map((x, k) => x - at[k])) > 0.6 * size);
    if (!far) return;
    stroke.push({ at, text: [...at.map((x, k) => x * scale + center[k]), size * scale].map((x) => Number(x.toPrecision(4))).join("/") });
    const pen = strokes.getContext("2d"), away = viewer.getCameraOrbit().radius;
    const reach = (size / away / Math.tan((viewer.getFieldOfView() * Math.PI) / 360)) * (box.height / 2);
    pen.fillStyle = byId("where").value === "near" ? "rgba(40, 160, 90, 0.35)" : "rgba(210, 60, 40, 0.35)";
    pen.beginPath();
    pen.arc(event.clientX - box.left, event.clientY - box.top, reach, 0, 7);
    pen.fill();
  }
  strokes.addEventListener("pointerdown", (event) => {
    strokes.width = strokes.clientWidth;
    strokes.height = strokes.clientHeight;
    strokes.setPointerCapture(event.pointerId);
    stroke = [];
    touch(event);
  });
  strokes.addEventListener("pointermove", (event) => { if (stroke) touch(event); });
  strokes.addEventListener("pointerup", () => {
    const kind = byId("where").value, there = painted(state.settings.mask);
    const balls = [...(there.kind === kind ? there.balls : []), ...stroke.map(({ text }) => text)];
    if (balls.length > MOST_BALLS) complain(`This is more than ${MOST_BALLS} dabs: take a larger brush, or paint a mask in your modelling program.`);
    else if (stroke.length) {
      before.push(state.settings.mask);
      change("mask", `${kind}:${balls.join("+")}`);
    }
    stroke = null;
    setTimeout(() => strokes.getContext("2d").clearRect(0, 0, strokes.width, strokes.height), 800);
  });
  byId("paint").addEventListener("click", () => paint(strokes.hidden));
  byId("undo").addEventListener("click", () => { if (before.length) change("mask", before.pop()); });
  byId("unpaint").addEventListener("click", () => {
    before.length = 0;
    change("mask", "");
  });
  byId("brush-size").addEventListener("input", () => { document.querySelector("output[for=brush-size]").value = byId("brush-size").value; });

  // ---------------------------------------------------------------- saving
  byId("save").addEventListener("click", () => attempt(async () => {
    const formats = [...document.querySelectorAll("#formats input:checked")].map((box) => box.value);
    byId("save").disabled = true;
    byId("save-hint").textContent = "saving …";
    try {
      const { files } = await post("save", { formats });
      byId("saved").replaceChildren(...files.map(({ name, path }) => {
        const item = document.createElement("li"), link = document.createElement("a");
        link.href = `saved/${encodeURIComponent(name)}`;
        link.download = name;
        link.textContent = path;
        item.append(link);
        return item;
      }));
      byId("saved").dataset.count = files.length;
    } finally {
      byId("save-hint").textContent = "";
      update();
    }
  }));
  byId("copy").addEventListener("click", async () => {
    getSelection().selectAllChildren(byId("command"));
    try { await navigator.clipboard.writeText(byId("command").textContent); byId("copy").textContent = "Copied"; }
    catch { byId("copy").textContent = "Selected"; }
  });
  byId("before").addEventListener("click", () => {
    const on = byId("before").getAttribute("aria-pressed") !== "true";
    byId("before").setAttribute("aria-pressed", String(on));
    byId("stage").classList.toggle("before", on);
  });
  const views = [byId("view-result"), byId("view-source")];
  const link = linkCameras(views, () => true);
  byId("home").addEventListener("click", () => {
    link.release();
    for (const viewer of views) aim(viewer, HOME.orbit, HOME.target, HOME.field);
  });

  // ---------------------------------------------------------------- from the studio to the page
  const WHERE = [["", "the whole surface"], ["height:0.5..1", "upper half"], ["height:0..0.5", "lower half"],
    ["slope:60", "upward-facing parts"], ["not:slope:60", "all but upward-facing parts"]];
  function places() {
    const attributes = state.source?.attributes || [];
    const all = [...WHERE, ...attributes.flatMap((name) =>
      [[`attribute:${name}`, `where ${name} is high`], [`not:attribute:${name}`, `where ${name} is low`]]), ...BRUSHES, ["own", "custom mask …"]];
    const key = JSON.stringify(all);
    if (byId("where").dataset.key !== key) {
      byId("where").dataset.key = key;
      byId("where").replaceChildren(...all.map(([value, text]) => new Option(text, value)));
    }
    const mask = state.settings.mask, choice = painted(mask).kind || mask;
    const known = all.some(([value]) => value === choice);
    // An empty mask leaves a brush that was chosen as it is.
    const brushing = !mask && BRUSHES.has(byId("where").value);
    if (document.activeElement !== byId("mask") && document.activeElement !== byId("where") && !brushing) {
      byId("where").value = known ? choice : "own";
      byId("mask-label").hidden = known;
      byId("brush").hidden = !BRUSHES.has(choice);
      byId("mask").value = mask;
    }
    byId("falloff-label").hidden = !mask;
    const direction = byId("direction");
    for (const name of attributes)
      if (![...direction.options].some((each) => each.value === `attribute:${name}`))
        direction.add(new Option(`attribute ${name}`, `attribute:${name}`));
  }

  function update() {
    const { settings } = state, busy = !["done", "failed"].includes(state.stage);
    root.classList.toggle("busy", busy);
    root.classList.toggle("failed", state.stage === "failed");
    byId("draft").hidden = !state.result || state.finished || state.learned > 0;
    byId("save").title = state.finished ? "" : "as soon as the result is finished";
    const unchanged = state.stage === "done" && state.result?.unchanged;
    root.classList.toggle("unchanged", unchanged);
    byId("stage-line").textContent = unchanged ? "Unchanged: this style has no relief"
      : state.stage === "done" ? (state.finished ? "Done" : "Stopped")
      : state.stage + (/^(preparing|synthesising)/.test(state.stage) && state.detail ? `: ${state.detail}` : "");
    byId("size-line").textContent = state.result ? `${state.result.vertices.toLocaleString()} vertices` +
      (state.learned ? `, ${state.learned} steps learned` : "") : "";
    if (state.error) complain(state.error);
    if (!timer) {
      for (const name of RANGES) {
        if (document.activeElement === byId(name)) continue;
        byId(name).value = (toControl[name] || Number)(settings[name]);
        document.querySelector(`output[for=${name}]`).value = label(name, settings[name]);
      }
      for (const name of ["direction", "steps"]) if (document.activeElement !== byId(name)) byId(name).value = settings[name];
      byId("invert").checked = settings.invert;
    }
    byId("seed").textContent = settings.seed;
    byId("invert-label").hidden = !state.style?.picture;
    byId("learn").textContent = learning() ? "Stop" : "Learn";
    byId("save").disabled = !state.finished;
    byId("command").textContent = state.command;
    byId("notes").replaceChildren(...state.notes.map((note) => {
      const item = document.createElement("li");
      item.textContent = note;
      return item;
    }));
    if (state.source) {
      byId("name-source").textContent = byId("name-source").title = state.source.name;
      byId("facts-source").textContent = `${state.source.vertices.toLocaleString()} vertices`;
      byId("name-style").textContent = byId("name-style").title = state.style.name;
      byId("facts-style").textContent = state.style.picture ? "a picture" : "a mesh";
    }
    places();
  }

  async function look(name) {
    const version = state.looks[name];
    if (version === undefined || shown[name] === version) return;
    const content = new Uint8Array(await (await fetch(`look/${name}`)).arrayBuffer());
    shown[name] = version;
    if (name === "style") {
      byId("picture-style").hidden = !state.style.picture;
      byId("small-style").hidden = state.style.picture;
      if (state.style.picture) byId("picture-style").src = URL.createObjectURL(new Blob([content], { type: "image/png" }));
      else await show(byId("small-style"), content, [SURFACE]);
    } else {
      if (name === "result") result = content;
      await show(byId(`view-${name}`), content, name === "result" ? nodes() : [SURFACE]);
      if (name === "source") await show(byId("small-source"), content, [SURFACE]);
      else byId("stage").dataset.shown = String(Number(byId("stage").dataset.shown || 0) + 1);
    }
  }

  const trouble = obstacle();
  if (trouble) complain(trouble);
  else await startViewer();
  while (true) {
    try {
      state = await ask(`state?since=${state ? state.version : -1}`);
      if (gone) complain("");
      gone = false;
      update();
      if (!trouble) for (const name of ["source", "style", "result"]) await look(name);
      await new Promise((next) => setTimeout(next, 100));
    } catch (error) {
      gone = true;
      complain(`The studio doesn't answer (${error.message}). Is it still running in the terminal?`);
      await new Promise((next) => setTimeout(next, 2000));
    }
  }
})();
