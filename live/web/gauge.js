function element(parent, name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
}
function arc(inner, outer, from, to) {
  const at = (r, a) => `${(r * Math.cos(a)).toFixed(2)} ${(r * Math.sin(a)).toFixed(2)}`;
  return `M${at(outer, from)}A${outer} ${outer} 0 0 1 ${at(outer, to)}L${at(inner, to)}A${inner} ${inner} 0 0 0 ${at(inner, from)}Z`;
}
// Where the ring is known in the picture, the gauge has its points at the same angles.
function angles(n) {
  const ring = scene.ring_px?.[0];
  if (!ring || ring.length !== n) return Array.from({length: n}, (_, i) => 2 * Math.PI * (i + 1) / n - Math.PI / 2);
  const x = ring.reduce((s, p) => s + p[0], 0) / n, y = ring.reduce((s, p) => s + p[1], 0) / n;
  return ring.map(p => Math.atan2(p[1] - y, p[0] - x));
}
function gauge() {
  const box = $("gauge"), n = scene.n, p = now.points;
  if (!changed("gauge", scene, p, palette)) return;
  box.replaceChildren();
  const defs = element(box, "defs", {}), hatch = element(defs, "pattern", {id: "hatch", width: 6, height: 6, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)"});
  element(hatch, "rect", {width: 6, height: 6, fill: style("--card")});
  element(hatch, "rect", {width: 2.4, height: 6, fill: style("--unknown")});
  const at = angles(n), half = Math.PI / Math.max(n, 1) * 0.94;
  let rest = 0, sum = 0, seen = 0;
  for (let i = 0; i < n; i++) {
    const [kind, why] = standing(i), share = p.completion?.[i], from = at[i] - half, to = at[i] + half;
    if (kind === "done" || kind === "stopped") rest++;
    if (known(share)) { sum += share; seen++; }
    const wedge = element(box, "path", {d: arc(84, 117, from, to), fill: known(share) ? colour(share) : "url(#hatch)", stroke: style("--line"), "stroke-width": 0.7});
    element(wedge, "title", {}, `point ${i + 1}: ${known(share) ? `${Math.round(100 * share)} %` : "not seen yet"}, ${why}`);
    const middle = r => [r * Math.cos(at[i]), r * Math.sin(at[i])];
    const [x, y] = middle(125), s = n > 24 ? 4.2 : 5.5;
    if (kind === "done") element(box, "path", {d: `M${x - s} ${y}l${0.8 * s} ${0.9 * s}l${1.2 * s} ${-1.8 * s}`, stroke: style("--green"), "stroke-width": 2.8, fill: "none"});
    else if (kind === "stopped") element(box, "path", {d: `M${x - s * .8} ${y - s * .8}l${1.6 * s} ${1.6 * s}m0 ${-1.6 * s}l${-1.6 * s} ${1.6 * s}`, stroke: style("--red"), "stroke-width": 2.8});
    else if (kind !== "unasked") {
      const a = r => [r * Math.cos(from), r * Math.sin(from), r * Math.cos(to), r * Math.sin(to)], [x0, y0, x1, y1] = a(124);
      element(box, "path", {d: `M${x0} ${y0}A124 124 0 0 1 ${x1} ${y1}`, fill: "none", "stroke-width": 8, stroke: style(kind === "yes" ? "--blue" : "--orange"), "stroke-dasharray": kind === "yes" ? "none" : "3 2"});
    }
    if (n <= 16 || i % 2 === 1) { const [lx, ly] = middle(139); element(box, "text", {x: lx, y: ly + 4, "text-anchor": "middle", "font-size": 11, fill: style("--soft")}, i + 1); }
  }
  const deepest = Math.max(0, ...(p.depth || []));
  const lines = [[`${seen ? Math.floor(100 * sum / seen) : "–"} %`, 44, 750, "--ink", -8], ["through, as seen", 13.5, 450, "--soft", 12], [`${um(deepest)} µm`, 24, 700, "--ink", 42], ["deepest cut", 13.5, 450, "--soft", 58]];
  for (const [text, size, weight, tint, y] of n ? lines : [["no ring yet", 20, 500, "--soft", 6]])
    element(box, "text", {x: 0, y, "text-anchor": "middle", "font-size": size, "font-weight": weight, fill: style(tint)}, text);
  $("rest").textContent = n ? `${rest} of ${n} at rest` + (seen < n ? `, ${n - seen} not seen yet` : "") : "";
}

