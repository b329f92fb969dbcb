"use strict";
(() => {
  const NAMESPACE = "http://www.w3.org/2000/svg";
  const percent = (share) => `${Math.round(100 * share)} %`;

  /** An element with attributes, text and children. */
  function make(tag, attributes = {}, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  }

  function draw(tag, attributes, text) {
    const element = document.createElementNS(NAMESPACE, tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text !== undefined) element.textContent = text;
    return element;
  }

  /** The margins of a typical episode over time; the piece that is in the cell is shaded. */
  function plotMargins(map, typical) {
    const [width, height, left, right, top, bottom] = [440, 190, 34, 8, 10, 30];
    const times = typical.time_s;
    const end = Math.max(times[times.length - 1], 1e-9);
    const all = typical.margins.flat();
    // Far from its limit a margin says little: the plot shows where it is close.
    const low = Math.max(Math.min(...all, -2), -12), high = Math.min(Math.max(...all, 6), 20);
    const x = (time) => left + (width - left - right) * time / end;
    const y = (margin) => top + (height - top - bottom) * (high - Math.min(Math.max(margin, low), high)) / (high - low);
    const plot = draw("svg", { class: "plot", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "Margins over time" });
    plot.append(draw("rect", { class: "below", x: left, y: y(0), width: width - left - right, height: y(low) - y(0) }));
    const from = typical.start_s, to = Math.min(from + map.horizon_s, end);
    plot.append(draw("rect", { class: "window", x: x(from), y: top, width: Math.max(x(to) - x(from), 3), height: y(low) - top }));
    plot.append(draw("line", { class: "axis", x1: left, x2: width - right, y1: y(0), y2: y(0) }));
    for (const value of [0, 5, 10, 15, 20, -5, -10]) {
      if (value >= low && value <= high) plot.append(draw("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, value));
    }
    for (const share of [0, 0.5, 1]) {
      plot.append(draw("text", { x: x(share * end), y: height - 12, "text-anchor": share === 0 ? "start" : share === 1 ? "end" : "middle" }, `${+(share * end).toFixed(2)} s`));
    }
    const dashes = ["", "7 3", "2 3", "9 3 2 3", "1 2", "12 4"];
    typical.margins.forEach((margins, i) => {
      const points = margins.map((margin, k) => `${x(times[k]).toFixed(1)},${y(margin).toFixed(1)}`).join(" ");
      plot.append(draw("polyline", { class: "line", points, stroke: map.colours[i], "stroke-dasharray": dashes[i % dashes.length] }));
    });
    return plot;
  }

  function showKey(key, view) {
    key.replaceChildren();
    if (view.swatches) {
      for (const [name, colour] of view.swatches) key.append(make("span", {}, make("i", { style: `background:${colour}` }), name));
    } else {
      key.append(make("span", {}, view.ends[0]), make("span", { class: "ramp", style: `background:linear-gradient(90deg,${view.stops.join(",")})` }), make("span", {}, view.ends[1]));
    }
    key.append(make("span", { class: "meaning" }, view.meaning));
  }

  function showCell(detail, map, cell) {
    const [safe, unsafe, unknown] = cell.belief;
    const isEmpty = unknown >= 1;
    const known = safe / (safe + unsafe);
    let verdict = "Empty: too few segments, the answer is “don't know”.";
    if (!isEmpty) {
      verdict = known > 0.8 ? "Motions through this cell mostly stay safe." : known < 0.2 ? "Motions through this cell mostly end unsafely." : "Motions through this cell end either way.";
    }
    detail.replaceChildren(
      make("h4", {}, `Cell ${cell.column + 1}, ${cell.row + 1}`),
      make("p", {}, `${verdict} ${isEmpty ? "Seen here:" : "Learned from"} ${cell.count} segment${cell.count === 1 ? "" : "s"}.`),
    );
    const parts = [["safe", safe, "var(--safe)"], ["don't know", unknown, "var(--unknown)"], ["unsafe", unsafe, "var(--unsafe)"]];
    const stack = make("div", { class: "stack" });
    const shares = make("div", { class: "shares" });
    for (const [name, share, colour] of parts) {
      stack.append(make("span", { style: `flex:${share} 0 0;background:${colour}` }));
      shares.append(make("span", {}, make("i", { style: `background:${colour}` }), `${name} ${percent(share)}`));
    }
    detail.append(stack, shares);
    if (!isEmpty) {
      detail.append(make("h5", {}, "Expected violations, if any"));
      cell.causes.forEach((mass, i) => {
        detail.append(make("div", { class: "cause" }, make("span", {}, map.causes[i]), make("span", {}, make("i", { style: `width:${100 * mass}%;background:${map.colours[i]}` })), make("span", {}, percent(mass))));
      });
    }
    const typical = cell.typical;
    if (typical) {
      const units = [...new Set(map.units)].join(", ");
      const came = typical.cause === "" ? "stayed safe" : `left the safe set: ${typical.cause.replaceAll("_", " ")}`;
      detail.append(
        make("h5", {}, `A typical episode: margins [${units}]`),
        plotMargins(map, typical),
      );
      const legend = make("div", { class: "shares" });
      map.causes.forEach((name, i) => legend.append(make("span", {}, make("i", { style: `background:${map.colours[i]}` }), name)));
      detail.append(legend, make("p", { class: "note" }, `Episode ${typical.episode}; it ${came}. Shaded: the segment in this cell. Below zero a constraint is violated.`));
    }
  }

  function openMap(article) {
    const map = JSON.parse(article.querySelector(".map-content").textContent);
    const cells = [...article.querySelectorAll(".cell")];
    const detail = article.querySelector(".detail");
    const key = article.querySelector(".key");
    const size = map.resolution;
    let chosen = 0;

    function choose(index) {
      cells[chosen].classList.remove("chosen");
      cells[chosen].setAttribute("tabindex", "-1");
      chosen = index;
      cells[index].classList.add("chosen");
      cells[index].setAttribute("tabindex", "0");
      showCell(detail, map, map.cells[index]);
    }

    function colour(name) {
      const view = map.views[name];
      cells.forEach((cell, i) => cell.setAttribute("fill", view.fills[i] ?? `url(#hatch-${map.mode})`));
      showKey(key, view);
    }

    cells.forEach((cell, i) => {
      cell.addEventListener("pointerenter", () => choose(i));
      cell.addEventListener("focus", () => choose(i));
      cell.addEventListener("keydown", (event) => {
        const step = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
        if (!step) return;
        event.preventDefault();
        const column = Math.min(Math.max(map.cells[i].column + step[0], 0), size - 1);
        const row = Math.min(Math.max(map.cells[i].row + step[1], 0), size - 1);
        cells[column * size + row].focus();
      });
    });
    article.querySelector(".view").addEventListener("change", (event) => colour(event.target.value));
    colour("safe");
    // Begins where most was seen.
    choose(map.cells.reduce((best, cell, i) => (cell.count > map.cells[best].count ? i : best), 0));
  }

  const articles = [...document.querySelectorAll(".map")];
  articles.forEach((article, i) => {
    openMap(article);
    article.hidden = i > 0;
    article.querySelector(".mode")?.addEventListener("change", (event) => {
      const wanted = event.target.value;
      event.target.value = article.dataset.mode;
      articles.forEach((other) => { other.hidden = other.dataset.mode !== wanted; });
      articles.find((other) => !other.hidden).querySelector(".mode").focus();
    });
  });

  /** Unpacks a recording that lies in the page, gzipped and in base64. */
  async function unpack(id) {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  for (const place of document.querySelectorAll(".recording")) {
    const button = place.querySelector("button");
    button.addEventListener("click", async () => {
      button.disabled = true;
      try {
        const frame = make("iframe", { title: "The recorded motion in 3-D", sandbox: "allow-scripts allow-downloads" });
        frame.srcdoc = await unpack(place.dataset.recording);
        button.replaceWith(frame);
      } catch (error) {
        button.disabled = false;
        place.querySelector(".note").textContent = `This browser cannot unpack the recording (${error.message}): open recording.html in the run's folder instead.`;
      }
    });
  }
})();
