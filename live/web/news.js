function happenings() {
  if (!changed("news", news)) return;
  $("news").querySelector("ul").replaceChildren(...[...news].reverse().slice(0, 60).map(each => {
    const li = document.createElement("li"), t = document.createElement("time"), b = document.createElement("b");
    li.className = each.fault ? "fault" : "";
    t.textContent = clock(each.t);
    b.textContent = (each.fault ? "⚠ " : "") + each.what;
    li.append(t, b, each.why ? ` ${each.why}` : "");
    return li;
  }));
}

