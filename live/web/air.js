// In free air: the setpoints in space, each on a stem from the lowest height, and what an examination finds.
function setpoints() {
  const all = scene.setpoints, box = $("map");
  if (!changed("setpoints", all, scene.fit, palette)) return;
  const seen = all.filter(each => each.state === "seen").length, missed = all.filter(each => each.state === "missed").length;
  $("visited").textContent = all.length ? `${seen + missed} of ${all.length}${missed ? `, ${missed} not seen` : ""}` : "";
  $("fit").textContent = scene.fit ? `${scene.fit.model} model, held-out error ${scene.fit.rmse_mm.toFixed(3)} mm` : "";
  box.replaceChildren();
  if (!all.length) { element(box, "text", {x: 150, y: 130, "text-anchor": "middle", "font-size": 20, fill: style("--soft")}, "none yet"); return; }
  const low = [0, 1, 2].map(k => Math.min(...all.map(each => each.at_mm[k]))), high = [0, 1, 2].map(k => Math.max(...all.map(each => each.at_mm[k])));
  const flat = ([x, y, z]) => [0.87 * (x - low[0]) - 0.5 * (y - low[1]), -0.35 * (x - low[0]) - 0.5 * (y - low[1]) - (z - low[2])];
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map(k => flat([0, 1, 2].map(i => k >> i & 1 ? high[i] : low[i])));
  const xs = corners.map(p => p[0]), ys = corners.map(p => p[1]), by = Math.min(250 / (Math.max(...xs) - Math.min(...xs) || 1), 210 / (Math.max(...ys) - Math.min(...ys) || 1));
  const to = place => { const [a, b] = flat(place); return [150 + by * (a - (Math.max(...xs) + Math.min(...xs)) / 2), 130 + by * (b - (Math.max(...ys) + Math.min(...ys)) / 2)]; };
  const ground = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]].map(([x, y]) => to([x, y, low[2]]).join()).join(" ");
  element(box, "polygon", {points: ground, fill: style("--grid"), stroke: style("--line")});
  const next = all.findIndex(each => each.state === "waiting");
  // Those behind first.
  all.map((each, i) => ({...each, i})).sort((a, b) => b.at_mm[1] - a.at_mm[1]).forEach(({at_mm, state, i}) => {
    const [x, y] = to(at_mm), [fx, fy] = to([at_mm[0], at_mm[1], low[2]]);
    element(box, "line", {x1: x, y1: y, x2: fx, y2: fy, stroke: style("--unknown"), "stroke-width": 1});
    if (state === "missed") element(box, "path", {d: `M${x - 6} ${y - 6}l12 12m0 -12l-12 12`, stroke: style("--red"), "stroke-width": 3.5});
    else element(box, "circle", {cx: x, cy: y, r: 7, fill: style(state === "seen" ? "--blue" : "--card"), stroke: style(state === "seen" ? "--card" : "--soft"), "stroke-width": 2, "stroke-dasharray": state === "seen" ? "none" : "3 2"});
    if (i === next && !now.outcome) element(box, "circle", {cx: x, cy: y, r: 12, fill: "none", stroke: style("--ink"), "stroke-width": 3});
    element(element(box, "circle", {cx: x, cy: y, r: 9, fill: "transparent"}), "title", {}, `${at_mm.join(", ")} mm: ${state}`);
  });
}

function checks() {
  const all = scene.checks;
  if (!changed("checks", all)) return;
  const failed = all.filter(each => each.verdict !== "pass"), passed = all.filter(each => each.verdict === "pass");
  $("found").textContent = all.length ? `${passed.length} passed${failed.length ? `, ${failed.length} failed` : ""}` : "none yet";
  // What failed stays on top; below, the newest first.
  $("checks").querySelector("ul").replaceChildren(...[...failed, ...passed.reverse()].map(each => {
    const li = document.createElement("li"), make = (name, text) => { const made = document.createElement(name); made.textContent = text; li.append(made); return made; };
    li.className = each.verdict === "pass" ? "done" : "stopped";
    make("span", each.verdict === "pass" ? "✓" : "✕").className = "sign";
    make("b", each.name);
    make("span", `${figure(each.value)} ${each.unit}`.trim());
    make("i", each.limit);
    if (each.advice && each.verdict !== "pass") make("p", each.advice);
    return li;
  }));
}
const figure = value => typeof value !== "number" ? value : Math.abs(value) >= 1000 ? value.toFixed(0) : String(Number(value.toPrecision(4)));
