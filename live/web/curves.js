// Curves: name, unit, what the newest value is, and what is drawn.
const CURVES = [
  {name: "Deepest and mean cut", unit: "µm", value: () => um(Math.max(0, ...(now.points.depth || []))), lines: [[1, 1000, "--ink"], [2, 1000, "--blue"]], bound: () => scene.limit_mm && [1000 * scene.limit_mm, "limit"], zero: true},
  {name: "Contact found at", unit: "mm", value: () => contacts.length ? contacts.at(-1)[1].toFixed(3) : "–", dots: true},
  {name: "Torque of rated", unit: "%", value: () => known(now.torque) ? (100 * now.torque).toFixed(1) : "–", lines: [[3, 100, "--ink"]], bound: () => known(now.idle) && [100 * now.idle, "in the air"], zero: true},
  {name: "Spindle speed", unit: "rpm", value: () => known(now.rpm) ? Math.round(now.rpm).toLocaleString("en") : "–", lines: [[4, 1, "--ink"]], zero: true},
  {name: "Age of the picture read", unit: "ms", value: () => known(now.age_s) ? Math.round(1000 * now.age_s) : "–", lines: [[5, 1000, "--ink"]], bound: () => [100, "limit"], zero: true},
];
for (const each of CURVES) {
  const row = document.createElement("div"), left = document.createElement("div"), label = document.createElement("span");
  row.className = "curve";
  each.strong = document.createElement("strong");
  each.canvas = document.createElement("canvas");
  label.textContent = each.name;
  left.append(label, each.strong);
  row.append(left, each.canvas);
  $("curves").append(row);
}
const seen = new ResizeObserver(() => { for (const each of CURVES) each.size = {w: each.canvas.clientWidth, h: each.canvas.clientHeight}; if (now) curves(); });
for (const each of CURVES) { each.size = {w: 0, h: 0}; seen.observe(each.canvas); }
function curves() {
  const until = now.t, from = Math.min(rows[0]?.[0] ?? 0, until - 1);
  for (const each of CURVES) {
    each.strong.replaceChildren(String(each.value()), Object.assign(document.createElement("em"), {textContent: ` ${each.unit}`}));
    const c = each.canvas, {w, h} = each.size, by = devicePixelRatio;
    if (!w) continue;
    if (c.width !== Math.round(w * by)) { c.width = Math.round(w * by); c.height = Math.round(h * by); }
    const g = c.getContext("2d");
    g.setTransform(by, 0, 0, by, 0, 0);
    g.clearRect(0, 0, w, h);
    const bound = each.bound?.() || null, dots = each.dots ? contacts.filter(p => p[0] <= until) : [];
    const values = each.dots ? dots.map(p => p[1]) : rows.flatMap(r => each.lines.map(([k, f]) => known(r[k]) ? r[k] * f : null)).filter(known);
    if (bound) values.push(bound[0]);
    if (!values.length) continue;
    let low = values.reduce((a, b) => Math.min(a, b)), high = values.reduce((a, b) => Math.max(a, b));
    if (each.zero) low = Math.min(0, low);
    if (high - low < 1e-9) { high += 0.5; low -= 0.5; }
    const pad = 46, x = t => (t - from) / Math.max(until - from, 1e-9) * (w - pad - 4), y = v => h - 6 - (v - low) / (high - low) * (h - 14);
    g.font = "13px system-ui, sans-serif"; g.textBaseline = "middle"; g.lineWidth = 1;
    for (const v of [low, high]) {
      g.strokeStyle = style("--grid"); g.beginPath(); g.moveTo(0, y(v)); g.lineTo(w - pad, y(v)); g.stroke();
      g.fillStyle = style("--soft"); g.fillText(Math.abs(v) >= 10 ? Math.round(v) >= 10000 ? `${Math.round(v / 1000)}k` : Math.round(v) : Number(v.toFixed(2)), w - pad + 6, Math.min(h - 7, Math.max(7, y(v))));
    }
    if (bound) {
      g.strokeStyle = style("--orange"); g.setLineDash([6, 4]); g.beginPath(); g.moveTo(0, y(bound[0])); g.lineTo(w - pad, y(bound[0])); g.stroke(); g.setLineDash([]);
      g.fillStyle = style("--orange"); g.fillText(bound[1], 4, y(bound[0]) + (y(bound[0]) < 16 ? 9 : -8));
    }
    for (const p of dots) { g.fillStyle = style("--ink"); g.beginPath(); g.arc(x(p[0]), y(p[1]), 3.2, 0, 7); g.fill(); }
    for (const [k, f, tint] of each.lines || []) {
      g.strokeStyle = style(tint); g.lineWidth = tint === "--ink" ? 2.2 : 1.6; g.beginPath();
      let pen = false;
      for (const r of rows) { if (r[0] > until || !known(r[k])) { pen = false; continue; } g[pen ? "lineTo" : "moveTo"](x(r[0]), y(r[k] * f)); pen = true; }
      g.stroke();
    }
  }
}

