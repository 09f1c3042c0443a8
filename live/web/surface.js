// The surface as both eyes measured it, the path on it, what is cut, and the drill: turned by dragging or with the arrow keys.
const STRETCH = 2, view = {turn: null, tilt: 0.8}, hills = {canvas: $("hills"), w: 0, h: 0, alone: document.createElement("canvas")};
$("stretched").textContent = `height × ${STRETCH}`;
new ResizeObserver(() => { hills.w = hills.canvas.clientWidth; hills.h = hills.canvas.clientHeight; if (now) surface(); }).observe(hills.canvas);

// As the left eye has it, and a little aside.
function upright() {
  const px = scene.ring_px?.[0], mm = scene.path_mm;
  if (!px || !mm || px.length !== mm.length) return null;
  const mean = (places, k) => places.reduce((s, p) => s + p[k], 0) / places.length, [u, v, x, y] = [mean(px, 0), mean(px, 1), mean(mm, 0), mean(mm, 1)];
  let [re, im] = [0, 0];
  px.forEach((p, i) => { const [a, b, c, d] = [p[0] - u, v - p[1], mm[i][0] - x, mm[i][1] - y]; re += a * c + b * d; im += b * c - a * d; });
  return Math.atan2(im, re) + 0.35;
}

// From millimetres to pixels, and how far away.
function looked() {
  const s = scene.surface, middle = axis => (Math.min(...axis) + Math.max(...axis)) / 2, at = [middle(s.x), middle(s.y), middle(s.z.flat())];
  const by = Math.min(hills.w / (1.45 * (s.x.at(-1) - s.x[0])), hills.h / (1.15 * (s.y.at(-1) - s.y[0])));
  const seen = view.turn ?? upright() ?? 0;
  const [ct, st, cf, sf] = [Math.cos(seen), Math.sin(seen), Math.cos(view.tilt), Math.sin(view.tilt)];
  return ([x, y, z]) => {
    const a = x - at[0], b = y - at[1], c = STRETCH * (z - at[2]), away = a * st + b * ct;
    return [hills.w / 2 + by * (a * ct - b * st), hills.h / 2 - by * (away * sf + c * cf), away * cf - c * sf];
  };
}

function surface() {
  const {canvas, w, h, alone} = hills, by = devicePixelRatio;
  if (!w || !scene.surface || !changed("surface", scene.surface, scene.ring_px, scene.path_mm, now.points, now.tip_mm, view, palette, w, h, by)) return;
  const to = looked();
  for (const each of [canvas, alone]) if (each.width !== Math.round(w * by) || each.height !== Math.round(h * by)) { each.width = Math.round(w * by); each.height = Math.round(h * by); before.bone = ""; }
  if (changed("bone", scene.surface, scene.ring_px, view, palette, w, h, by)) bone(alone.getContext("2d"), to, by);
  const g = canvas.getContext("2d");
  g.setTransform(1, 0, 0, 1, 0, 0);
  g.clearRect(0, 0, canvas.width, canvas.height);
  g.drawImage(alone, 0, 0);
  g.setTransform(by, 0, 0, by, 0, 0);
  path(g, to);
  if (now.tip_mm) drill(g, to, now.tip_mm);
}

// Quads from far to near, each as bright as the light falls on it.
function bone(g, to, by) {
  const {x, y, z} = scene.surface, quads = [], [dx, dy] = [x[1] - x[0], y[1] - y[0]];
  for (let j = 0; j + 1 < y.length; j++) for (let i = 0; i + 1 < x.length; i++) {
    const corners = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]].map(([a, b]) => to([x[a], y[b], z[b][a]]));
    const n = [-STRETCH * (z[j][i + 1] - z[j][i]) / dx, -STRETCH * (z[j + 1][i] - z[j][i]) / dy, 1], size = Math.hypot(...n);
    const light = Math.max(0, (-0.5 * n[0] + 0.35 * n[1] + 0.79 * n[2]) / size);
    quads.push({corners, away: corners.reduce((s, p) => s + p[2], 0), shade: 0.35 + 0.6 * light});
  }
  quads.sort((a, b) => b.away - a.away);
  g.setTransform(by, 0, 0, by, 0, 0);
  g.clearRect(0, 0, hills.w, hills.h);
  for (const {corners, shade} of quads) {
    g.fillStyle = g.strokeStyle = `rgb(${[214, 204, 188].map(c => Math.round(c * shade)).join()})`;
    g.beginPath();
    corners.forEach(([a, b], k) => g[k ? "lineTo" : "moveTo"](a, b));
    g.closePath(); g.fill(); g.stroke();
  }
}

// The path on the bone, and under each point how deep it is cut.
function path(g, to) {
  const places = scene.path_mm;
  if (!places) return;
  for (const [width, tint] of [[5, "#000000"], [2, "#ffffff"]]) {
    g.lineWidth = width; g.strokeStyle = tint; g.beginPath();
    places.map(to).forEach(([a, b], k) => g[k ? "lineTo" : "moveTo"](a, b));
    g.closePath(); g.stroke();
  }
  places.forEach((place, i) => {
    const [a, b] = to(place), share = now.points.completion?.[i], cut = now.points.depth?.[i] || 0, [c, d] = to([place[0], place[1], place[2] - cut]);
    if (cut) { g.lineWidth = 4; g.strokeStyle = "#000000"; g.beginPath(); g.moveTo(a, b); g.lineTo(c, d); g.stroke(); }
    g.beginPath(); g.arc(a, b, 6, 0, 7);
    g.fillStyle = known(share) ? colour(share) : "#6b717c"; g.fill();
    g.lineWidth = 2; g.strokeStyle = "#ffffff"; g.setLineDash(known(share) ? [] : [3, 3]); g.stroke(); g.setLineDash([]);
  });
  const flat = places.map(to), [mx, my] = [0, 1].map(k => flat.reduce((s, p) => s + p[k], 0) / flat.length);
  flat.forEach(([a, b], i) => { if (i % 4 === 3) label(g, String(i + 1), a + 0.22 * (a - mx) - 8, b + 0.22 * (b - my), "#ffffff", 15); });
}

function drill(g, to, tip) {
  const [a, b] = to(tip), [c, d] = to([tip[0], tip[1], tip[2] + 1.2]);
  for (const [width, tint] of [[8, "#000000"], [4, "#ff9df0"]]) { g.lineWidth = width; g.strokeStyle = tint; g.lineCap = "round"; g.beginPath(); g.moveTo(a, b); g.lineTo(c, d); g.stroke(); }
  label(g, "tip", c + 8, d, "#ff9df0", 17);
}

function turn(by, tilt) {
  view.turn = (view.turn ?? upright() ?? 0) + by;
  view.tilt = Math.min(1.5, Math.max(0.15, view.tilt + tilt));
  if (now) surface();
}
hills.canvas.addEventListener("pointerdown", event => hills.canvas.setPointerCapture(event.pointerId));
hills.canvas.addEventListener("pointermove", event => { if (event.buttons) turn(0.01 * event.movementX, event.pointerType === "touch" ? 0 : 0.01 * event.movementY); });
hills.canvas.addEventListener("keydown", event => {
  const step = {ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1]}[event.key];
  if (step) { event.preventDefault(); turn(...step); }
});
