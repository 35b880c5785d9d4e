"use strict";
// The page's data blocks, the 3D viewer, and cameras that move together.

const byId = (id) => document.getElementById(id);
const SURFACE = 0, HEAT = 1, EDGES = 2; // nodes of our GLB files, see glb.py

async function inflate(id) {
  const text = atob(byId(id).textContent.trim());
  const packed = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Why meshes can't be shown here, or null.
function obstacle() {
  if (!("DecompressionStream" in window)) return "This browser is too old to show the meshes.";
  if (!document.createElement("canvas").getContext("webgl2"))
    return "This browser has no WebGL 2, so the meshes can't be shown in 3D.";
  return null;
}

async function startViewer() {
  const script = document.createElement("script");
  script.src = URL.createObjectURL(new Blob([await inflate("viewer-code")], { type: "text/javascript" }));
  await new Promise((loaded, failed) => {
    script.onload = loaded;
    script.onerror = failed;
    document.head.append(script);
  });
  const surroundings = lights();
  for (const viewer of document.querySelectorAll("model-viewer"))
    viewer.environmentImage = surroundings;
}

// Surroundings for the meshes to be lit by: a lamp above on the left of the first view, a weaker one
// behind, and dim light from everywhere, so that relief throws shade. An equirectangular picture in
// Radiance's format, uncompressed.
function lights() {
  const width = 128, height = 64, pixels = new Uint8Array(4 * width * height);
  const lamps = [[-0.45, 0.62, 0.9, 14], [0.75, 0.35, -0.7, 4]]; // x, y, z, radiance
  for (let row = 0; row < height; row++)
    for (let column = 0; column < width; column++) {
      const up = Math.PI * (0.5 - (row + 0.5) / height);
      const around = 2 * Math.PI * ((column + 0.5) / width - 0.5);
      const towards = [Math.cos(up) * Math.cos(around), Math.sin(up), Math.cos(up) * Math.sin(around)];
      let radiance = 0.28 + 0.12 * towards[1];
      for (const [x, y, z, strength] of lamps) {
        const cosine = (towards[0] * x + towards[1] * y + towards[2] * z) / Math.hypot(x, y, z);
        radiance += strength * Math.exp(-18 * (1 - cosine));
      }
      const exponent = Math.ceil(Math.log2(radiance));
      const mantissa = Math.min(255, Math.floor((radiance / 2 ** exponent) * 256));
      pixels.set([mantissa, mantissa, mantissa, exponent + 128], 4 * (row * width + column));
    }
  const head = `#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y ${height} +X ${width}\n`;
  return URL.createObjectURL(new Blob([head, pixels])) + "#.hdr"; // the viewer goes by the name's end
}

// The GLB file with other nodes in its scene.
function withNodes(glb, nodes) {
  const length = new DataView(glb.buffer, glb.byteOffset).getUint32(12, true);
  const scene = JSON.parse(new TextDecoder().decode(glb.subarray(20, 20 + length)));
  scene.scenes[0].nodes = nodes.filter((node) => node < scene.nodes.length);
  const text = new TextEncoder().encode(JSON.stringify(scene));
  const padded = new Uint8Array(4 * Math.ceil(text.length / 4)).fill(32);
  padded.set(text);
  const head = glb.slice(0, 20), view = new DataView(head.buffer);
  view.setUint32(8, glb.length - length + padded.length, true);
  view.setUint32(12, padded.length, true);
  return new Blob([head, padded, glb.subarray(20 + length)], { type: "model/gltf-binary" });
}

// Show these nodes of a file; resolves when they are on the screen.
async function show(viewer, glb, nodes) {
  const url = URL.createObjectURL(withNodes(glb, nodes));
  if (viewer.loaded) viewer.cameraOrbit = viewer.getCameraOrbit().toString();
  const shown = new Promise((loaded, failed) => {
    viewer.addEventListener("load", loaded, { once: true });
    viewer.addEventListener("error", (event) => failed(new Error(event.detail.type)), { once: true });
  });
  viewer.src = url;
  await shown;
  URL.revokeObjectURL(url);
}

const HOME = { orbit: "35deg 72deg 3.1m", target: "0m 0m 0m", field: "40deg" };

function aim(viewer, orbit, target, field) {
  viewer.cameraOrbit = orbit;
  viewer.cameraTarget = target;
  viewer.fieldOfView = field;
  viewer.jumpCameraToGoal();
}

// The viewer that was touched last leads; the others follow while `linked()`.
function linkCameras(viewers, linked) {
  let leader = null;
  for (const viewer of viewers) {
    for (const kind of ["pointerdown", "keydown", "wheel"])
      viewer.addEventListener(kind, () => { leader = viewer; }, { capture: true, passive: true });
    viewer.addEventListener("camera-change", () => {
      if (viewer !== leader || !linked()) return;
      const orbit = viewer.getCameraOrbit().toString(), target = viewer.getCameraTarget().toString();
      for (const other of viewers)
        if (other !== viewer) aim(other, orbit, target, `${viewer.getFieldOfView()}deg`);
    });
  }
  return { release() { leader = null; } };
}

// Turns all viewers together until `turning()` is false or the next call.
let turns = 0;
function turnTogether(viewers, turning) {
  const turn = ++turns;
  let before = null;
  function frame(now) {
    if (turn !== turns || !turning()) return;
    const angle = before === null ? 0 : Math.min(now - before, 100) * 0.0005;
    before = now;
    for (const viewer of viewers) {
      const orbit = viewer.getCameraOrbit();
      viewer.cameraOrbit = `${orbit.theta + angle}rad ${orbit.phi}rad ${orbit.radius}m`;
      viewer.jumpCameraToGoal();
    }
    requestAnimationFrame(frame);
  }
  requestAnimationFrame(frame);
}
