function reasons() {
  if (!changed("reasons", scene.n, now.points)) return;
  const groups = new Map();
  for (let i = 0; i < scene.n; i++) {
    const [kind, why] = standing(i), text = kind === "done" ? "finished" : why.replace(/: [\d.]+ %$/, ""), key = `${kind}|${text}`;
    if (!groups.has(key)) groups.set(key, {kind, text, points: []});
    groups.get(key).points.push(i + 1);
  }
  const order = ["no", "stopped", "unasked", "yes", "done"], sign = {yes: "▼", no: "▲", stopped: "✕", done: "✓", unasked: "?"};
  const word = {yes: "permitted", no: "withheld", stopped: "stopped", done: "finished", unasked: "unknown"};
  const sorted = [...groups.values()].sort((a, b) => order.indexOf(a.kind) - order.indexOf(b.kind) || b.points.length - a.points.length);
  $("why").querySelector("ul").replaceChildren(...sorted.map(each => {
    const li = document.createElement("li"), s = document.createElement("span"), b = document.createElement("b"), i = document.createElement("i");
    li.className = each.kind; s.className = "sign"; s.textContent = sign[each.kind];
    b.textContent = each.kind === "done" ? "finished" : `${word[each.kind]}: ${each.text}`;
    i.textContent = each.points.length === scene.n ? "every point" : `${each.points.length === 1 ? "point" : "points"} ${ranges(each.points)}`;
    li.append(s, b, i);
    return li;
  }));
}
function ranges(numbers) {
  const parts = [];
  for (const n of numbers) parts.length && n === parts.at(-1)[1] + 1 ? parts.at(-1)[1] = n : parts.push([n, n]);
  return parts.map(([a, b]) => a === b ? a : b === a + 1 ? `${a}, ${b}` : `${a}–${b}`).join(", ");
}

function table() {
  if (!$("points").open) return;
  const p = now.points, percent = v => known(v) ? `${Math.round(100 * v)} %` : "not seen";
  $("points").querySelector("tbody").replaceChildren(...Array.from({length: scene.n}, (_, i) => {
    const tr = document.createElement("tr");
    for (const text of [i + 1, p.contact[i] ? "found" : "–", `${um(p.depth[i])} µm`, percent(p.completion[i]), percent(p.upper[i]), p.state[i], standing(i)[1]]) tr.append(Object.assign(document.createElement("td"), {textContent: text}));
    return tr;
  }));
}

