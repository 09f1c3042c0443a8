// Pictures: the part round the ring, the ring by completion, the drill by calibration.
function picture(k) {
  const eye = eyes[k], canvas = $(`eye${k}`), g = canvas.getContext("2d");
  const age = known(eye.t) ? Math.max(0, now.t - eye.t + (live && !now.ended ? now.silent_s || 0 : 0)) : null;
  $(`age${k}`).textContent = age === null ? "no picture yet" : age < 1 ? "now" : `${age < 10 ? age.toFixed(1) : Math.round(age)} s ago`;
  $(`age${k}`).className = age > 3 ? "old" : "";
  if (!eye.bitmap || !changed(`eye${k}`, eye.number, scene, now.points, now.tip_px)) return;
  const [x0, y0, x1, y1] = eye.region, by = canvas.width / (x1 - x0);
  const part = eye.whole ? [x0, y0, x1 - x0, y1 - y0] : [0, 0, eye.bitmap.width, eye.bitmap.height];
  g.drawImage(eye.bitmap, ...part, 0, 0, canvas.width, canvas.height);
  const to = ([x, y]) => [(x - x0) * by, (y - y0) * by];
  const ring = scene.ring_px?.[k];
  if (ring && ring.length === scene.n) ring.forEach((place, i) => {
    const [x, y] = to(place), share = now.points.completion?.[i], [kind] = standing(i), r = Math.max(6, 0.085 * by * radius(ring));
    g.lineWidth = 3.5; g.strokeStyle = "#000000"; g.beginPath(); g.arc(x, y, r + 1.5, 0, 7); g.stroke();
    if (known(share)) { g.fillStyle = colour(share); g.beginPath(); g.arc(x, y, r, 0, 7); g.fill(); }
    g.setLineDash(known(share) ? [] : [4, 4]); g.lineWidth = 2.2; g.strokeStyle = "#ffffff"; g.beginPath(); g.arc(x, y, r, 0, 7); g.stroke(); g.setLineDash([]);
    const mark = known(share) ? {done: "✓", stopped: "✕"}[kind] : "?";
    if (mark) { g.font = `bold ${1.5 * r}px sans-serif`; g.textAlign = "center"; g.textBaseline = "middle"; g.lineWidth = 3; g.strokeStyle = "#000"; g.strokeText(mark, x, y); g.fillStyle = "#fff"; g.fillText(mark, x, y); }
  });
  for (const name in scene.marks_px[k]) {
    const [x, y] = to(scene.marks_px[k][name]);
    g.lineWidth = 5; g.strokeStyle = "#000";
    for (const pass of [0, 1]) { g.beginPath(); g.moveTo(x - 13, y); g.lineTo(x + 13, y); g.moveTo(x, y - 13); g.lineTo(x, y + 13); g.stroke(); g.lineWidth = 2.2; g.strokeStyle = "#7fe3ff"; }
    label(g, name, x + 16, y - 12, "#7fe3ff");
  }
  const tip = now.tip_px?.[k];
  if (tip) {
    const [cx, cy] = to(tip[0]), r = tip[1] ? Math.hypot(to(tip[1])[0] - cx, to(tip[1])[1] - cy) : 22;
    g.lineWidth = 5; g.strokeStyle = "#000"; g.beginPath(); g.arc(cx, cy, r, 0, 7); g.stroke();
    g.lineWidth = 2.5; g.strokeStyle = "#ff9df0"; g.beginPath(); g.arc(cx, cy, r, 0, 7); g.stroke();
    label(g, "tip", cx + r + 6, cy, "#ff9df0");
  }
}
function radius(ring) {
  const x = ring.reduce((s, p) => s + p[0], 0) / ring.length, y = ring.reduce((s, p) => s + p[1], 0) / ring.length;
  return ring.reduce((s, p) => s + Math.hypot(p[0] - x, p[1] - y), 0) / ring.length;
}
function label(g, text, x, y, tint, size = 24) {
  g.font = `600 ${size}px system-ui, sans-serif`; g.textAlign = "left"; g.textBaseline = "middle"; g.lineWidth = 5; g.strokeStyle = "#000"; g.lineJoin = "round";
  g.strokeText(text, x, y); g.fillStyle = tint; g.fillText(text, x, y);
}

