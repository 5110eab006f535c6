(() => {
  const root = document.querySelector(".explorer");
  if (!root) return;
  const content = JSON.parse(root.querySelector("script").textContent);
  root.hidden = false;
  const VIRIDIS = ["440154", "482475", "414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70",
    "7ad151", "bddf26", "fde725"].map((h) => [0, 2, 4].map((k) => parseInt(h.slice(k, k + 2), 16)));
  const SERIES = ["#d55e00", "#0072b2", "#009e73", "#e69f00", "#cc79a7", "#56b4e9"];
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colour = (t) => {
    const x = Math.min(Math.max(t, 0), 1) * (VIRIDIS.length - 1), k = Math.min(Math.floor(x), 9);
    return VIRIDIS[k].map((low, c) => low + (VIRIDIS[k + 1][c] - low) * (x - k));
  };
  // False-alarm probabilities: grey down to the threshold of a detection, orange to red below it.
  const chance = (logP) => {
    const edge = Math.log10(content.alpha), least = Math.log10(content.least_probability);
    if (logP > edge) return Array(3).fill(242 - 104 * Math.min(logP / edge, 1));
    const t = least < edge ? (edge - logP) / (edge - least) : 1;
    return [230 - 17 * t, 159 - 65 * t, 0];
  };
  // Numbers as on the rest of the page: a true minus, powers of ten, no more digits than mean something.
  const SUPER = { "-": "⁻", ...Object.fromEntries([..."0123456789"].map((d, k) => [d, "⁰¹²³⁴⁵⁶⁷⁸⁹"[k]])) };
  const plain = (x, digits = 3) => {
    if (!Number.isFinite(x)) return "–";
    if (x !== 0 && (Math.abs(x) < 1e-3 || Math.abs(x) >= 1e5)) {
      const [head, power] = x.toExponential(digits - 1).split("e");
      const raised = [...power.replace("+", "")].map((c) => SUPER[c]).join("");
      return `${head}\u00a0×\u00a010${raised}`.replace("-", "−");
    }
    const places = x === 0 ? 0 : Math.max(0, digits - 1 - Math.floor(Math.log10(Math.abs(x))));
    return x.toFixed(places).replace("-", "−");
  };
  const measured = (x, error) => {  // as many digits as the error leaves: two of its own
    if (!(error > 0) || !Number.isFinite(x)) return plain(x);
    const places = Math.min(Math.max(0, 1 - Math.floor(Math.log10(error))), 12);
    return `${x.toFixed(places)} ± ${error.toFixed(places)}`.replace("-", "−");
  };
  const tick = (x) => `${+x.toPrecision(6)}`.replace("-", "−");
  const floats = (text) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  };
  const fitted = (canvas, height) => {
    const wide = canvas.clientWidth, ratio = devicePixelRatio || 1;
    canvas.style.height = `${height}px`;
    canvas.width = Math.round(wide * ratio);
    canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, wide, height);
    context.font = "12px system-ui, sans-serif";
    return [context, wide];
  };
  const steps = (low, high, n) => {
    const rough = (high - low) / n, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((m) => m * power >= rough), first = Math.ceil(low / step);
    const found = [];
    for (let k = first; k * step <= high * (1 + 1e-12) + 1e-12 * step; k++) found.push(+(k * step).toPrecision(10));
    return found;
  };
  const fill = (select, names) => names.forEach((name) => select.add(new Option(name, name)));

  // The map.
  const LAYERS = {
    "Δχ²": { layer: "delta_chi2", low: 0 },
    "contrast": { layer: "contrast", low: 0 },
    "false-alarm probability": { layer: "log_probability", probability: true },
  };
  const side = 2 * content.half + 1;
  const maps = Object.fromEntries(Object.entries(content.maps).map(([kind, layers]) =>
    [kind, Object.fromEntries(Object.entries(layers).map(([name, text]) => [name, floats(text)]))]));
  const panel = root.querySelector(".sky-map"), canvas = panel.querySelector("canvas");
  const pickLayer = panel.querySelector(".layer"), pickKind = panel.querySelector(".kind");
  const said = panel.querySelector("output");
  fill(pickLayer, Object.keys(LAYERS).filter((name) => maps["all data"][LAYERS[name].layer]));
  fill(pickKind, Object.keys(maps));
  const view = { east: 0, north: 0, reach: 1.06 * content.outer_mas };
  const cursor = { east: content.marks[0].east, north: content.marks[0].north };
  const MARGIN = { left: 46, top: 10, bottom: 58 };
  let frame = { size: 1, bar: 0 };
  const range = () => {
    const { layer, probability, low } = LAYERS[pickLayer.value];
    if (probability) return [0, Math.log10(content.least_probability)];
    const values = maps[pickKind.value][layer];
    if (layer === "delta_chi2") return [low, values.reduce((a, b) => (b > a ? b : a), 1e-12)];
    // Close to the star the error of the contrast has no bound: the scale leaves that out.
    const known = [...values].filter((x) => x > 0).sort((a, b) => a - b);
    return [low, known[Math.floor(0.99 * known.length)] || 1e-12];
  };
  // The search claims one position: what is improbable elsewhere is structure, the darkest grey.
  const claimed = (east, north) => !content.detected ||
    Math.hypot(east - content.marks[0].east, north - content.marks[0].north) <= 0.5 * content.fringe_mas;
  const shade = (value, low, high, isClaimed = true) => {
    if (!LAYERS[pickLayer.value].probability) return colour((value - low) / (high - low));
    return chance(isClaimed ? value : Math.max(value, Math.log10(content.alpha) + 1e-9));
  };
  const painted = () => {
    const values = maps[pickKind.value][LAYERS[pickLayer.value].layer], [low, high] = range();
    const image = document.createElement("canvas");
    image.width = image.height = side;
    const context = image.getContext("2d"), pixels = context.createImageData(side, side);
    for (let row = 0; row < side; row++) for (let column = 0; column < side; column++) {
      const value = values[row * side + column];
      if (Number.isNaN(value)) continue;
      const k = 4 * ((side - 1 - row) * side + (side - 1 - column));  // north up, east left
      pixels.data.set([...shade(value, low, high, claimed((column - content.half) * content.step_mas,
        (row - content.half) * content.step_mas)), 255], k);
    }
    context.putImageData(pixels, 0, 0);
    return image;
  };
  const toX = (east) => MARGIN.left + frame.size * (0.5 - (east - view.east) / (2 * view.reach));
  const toY = (north) => MARGIN.top + frame.size * (0.5 - (north - view.north) / (2 * view.reach));
  const cell = () => {
    const near = (x) => Math.round(x / content.step_mas) + content.half;
    const [row, column] = [near(cursor.north), near(cursor.east)];
    if (Math.min(row, column) < 0 || Math.max(row, column) >= side) return -1;
    return row * side + column;
  };
  const drawMap = () => {
    const wide = canvas.clientWidth, size = Math.max(Math.min(wide - MARGIN.left - 12, 560), 40);
    const [context] = fitted(canvas, size + MARGIN.top + MARGIN.bottom);
    frame = { size };
    const ink = css("--ink"), soft = css("--soft"), scale = size / (2 * view.reach);
    context.save();
    context.beginPath();
    context.rect(MARGIN.left, MARGIN.top, size, size);
    context.clip();
    const edge = (content.half + 0.5) * content.step_mas;
    context.imageSmoothingEnabled = false;
    context.drawImage(painted(), toX(edge), toY(edge), 2 * edge * scale, 2 * edge * scale);
    const ring = (east, north, radius, style, width, dash = []) => {
      context.beginPath();
      context.setLineDash(dash);
      context.arc(toX(east), toY(north), radius, 0, 2 * Math.PI);
      for (const [stroke, line] of [["#fff", width + 2], [style, width]]) {
        if (dash.length && stroke === "#fff") continue;
        context.strokeStyle = stroke;
        context.lineWidth = line;
        context.stroke();
      }
      context.setLineDash([]);
    };
    for (const radius of [content.inner_mas, content.outer_mas]) ring(0, 0, radius * scale, soft, 1, [5, 4]);
    context.fillStyle = ink;
    context.font = "18px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText("★", toX(0), toY(0));
    for (const mark of content.marks) {
      if (mark.kind === "best") ring(mark.east, mark.north, 9, "#d55e00", 2.5);
      else {
        for (const [stroke, line] of [["#fff", 4], ["#000", 1.8]]) {
          context.strokeStyle = stroke;
          context.lineWidth = line;
          context.strokeRect(toX(mark.east) - 6, toY(mark.north) - 6, 12, 12);
        }
      }
    }
    context.strokeStyle = "#fff";
    context.globalCompositeOperation = "difference";
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(toX(cursor.east), 0); context.lineTo(toX(cursor.east), size + MARGIN.top);
    context.moveTo(0, toY(cursor.north)); context.lineTo(wide, toY(cursor.north));
    context.stroke();
    context.restore();
    axes(context, size, ink, soft, scale);
    bar(context, size, ink);
    readMap();
  };
  const axes = (context, size, ink, soft, scale) => {
    context.font = "12px system-ui, sans-serif";
    context.strokeStyle = soft;
    context.fillStyle = ink;
    context.lineWidth = 1;
    context.strokeRect(MARGIN.left, MARGIN.top, size, size);
    context.textAlign = "center";
    context.textBaseline = "top";
    const bottom = MARGIN.top + size;
    for (const east of steps(view.east - view.reach, view.east + view.reach, 5)) {
      context.fillText(tick(east), toX(east), bottom + 4);
    }
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const north of steps(view.north - view.reach, view.north + view.reach, 5)) {
      context.fillText(tick(north), MARGIN.left - 5, toY(north));
    }
    context.textAlign = "left";
    context.fillText("N ↑  ← E   (mas)", MARGIN.left + 6, MARGIN.top + 12);
    const width = content.fringe_mas * scale;
    if (width < 0.6 * size) {
      context.beginPath();
      context.moveTo(MARGIN.left + 8, bottom - 8);
      context.lineTo(MARGIN.left + 8 + width, bottom - 8);
      context.lineWidth = 2;
      context.strokeStyle = ink;
      context.stroke();
      context.fillText("λ/Bmax", MARGIN.left + 8, bottom - 18);
    }
  };
  const bar = (context, size, ink) => {
    const [low, high] = range(), top = MARGIN.top + size + 24, probability = LAYERS[pickLayer.value].probability;
    const scale = context.createLinearGradient(MARGIN.left, 0, MARGIN.left + size, 0);
    for (let k = 0; k <= 40; k++) scale.addColorStop(k / 40, `rgb(${shade(low + (high - low) * k / 40, low, high)})`);
    context.fillStyle = scale;
    context.fillRect(MARGIN.left, top, size, 10);
    context.fillStyle = ink;
    context.textBaseline = "top";
    context.textAlign = "left";
    const contrast = LAYERS[pickLayer.value].layer === "contrast";
    const text = (x) => (probability ? plain(10 ** x, 2) : contrast ? `${plain(100 * x)} %` : plain(x, 4));
    context.fillText(text(low), MARGIN.left, top + 13);
    context.textAlign = "right";
    context.fillText(probability ? `≤ ${text(high)}, as far as ${content.n_draws} draws tell` : text(high), MARGIN.left + size, top + 13);
  };
  const readMap = () => {
    const k = cell(), all = maps["all data"], now = maps[pickKind.value];
    const rho = Math.hypot(cursor.east, cursor.north), turn = Math.atan2(cursor.east, cursor.north) * 180 / Math.PI;
    const where = `${plain(rho, 4)} mas at ${plain((turn + 360) % 360, 4)}° (E ${plain(cursor.east, 4)}, N ${plain(cursor.north, 4)} mas)`;
    if (k < 0 || Number.isNaN(now.delta_chi2[k])) { said.textContent = `${where}: outside of the field`; return; }
    const c = now.contrast[k], lines = [`Δχ² ${plain(now.delta_chi2[k], 4)}`];
    lines.push(`contrast ${measured(100 * c, 100 * now.error[k])} %${c > 0 ? ` (${plain(-2.5 * Math.log10(c))} mag)` : ""}`);
    if (all.log_probability && pickKind.value === "all data") {
      const floor = Math.log10(content.least_probability) + 1e-5, p = all.log_probability[k];
      const told = `${p <= floor ? "below " : ""}${plain(10 ** p, 2)}`;
      const best = content.marks[0], apart = Math.hypot(cursor.east - best.east, cursor.north - best.north);
      const rest = content.detected && apart > 0.5 * content.fringe_mas ? ", with the companion taken out of the data" : "";
      lines.push(`false-alarm probability anywhere in the field ${told}${rest}`);
    }
    said.textContent = `${where}: ${lines.join("; ")}.`;
  };
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    return {
      east: view.east + (0.5 - (x - MARGIN.left) / frame.size) * 2 * view.reach,
      north: view.north + (0.5 - (y - MARGIN.top) / frame.size) * 2 * view.reach,
    };
  };
  const zoom = (factor, about = view) => {
    const reach = Math.min(Math.max(view.reach * factor, 4 * content.step_mas), 1.06 * content.outer_mas);
    const kept = reach / view.reach;
    view.east = about.east + (view.east - about.east) * kept;
    view.north = about.north + (view.north - about.north) * kept;
    view.reach = reach;
    held();
    drawMap();
  };
  const held = () => {
    const room = Math.max(1.06 * content.outer_mas - view.reach, 0);
    for (const name of ["east", "north"]) view[name] = Math.min(Math.max(view[name], -room), room);
  };
  let drag = null;
  canvas.addEventListener("pointerdown", (event) => { drag = { ...place(event), moved: false }; });
  canvas.addEventListener("pointermove", (event) => {
    const now = place(event);
    if (drag && event.buttons) {
      if (Math.hypot(now.east - drag.east, now.north - drag.north) > 0.01 * view.reach) drag.moved = true;
      view.east += drag.east - now.east;
      view.north += drag.north - now.north;
      held();
    } else Object.assign(cursor, now);
    drawMap();
  });
  addEventListener("pointerup", () => { drag = null; });
  canvas.addEventListener("click", (event) => { Object.assign(cursor, place(event)); canvas.focus(); drawMap(); });
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(event.deltaY > 0 ? 1.25 : 0.8, place(event));
  }, { passive: false });
  const STEP = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  canvas.addEventListener("keydown", (event) => {
    if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 0.7 : 1.4, cursor);
    if (!STEP[event.key]) return;
    event.preventDefault();
    cursor.east += STEP[event.key][0] * content.step_mas;
    cursor.north += STEP[event.key][1] * content.step_mas;
    drawMap();
  });
  panel.querySelector(".in").onclick = () => zoom(0.6, cursor);
  panel.querySelector(".out").onclick = () => zoom(1 / 0.6, cursor);
  panel.querySelector(".whole").onclick = () => { Object.assign(view, { east: 0, north: 0 }); zoom(1e9); };
  pickLayer.onchange = drawMap;
  pickKind.onchange = () => {
    for (const option of pickLayer.options) option.disabled = !maps[pickKind.value][LAYERS[option.value].layer];
    if (pickLayer.selectedOptions[0].disabled) pickLayer.selectedIndex = 0;
    drawMap();
  };

  // The data.
  const plot = root.querySelector(".data-plot"), sheet = plot.querySelector("canvas");
  const pickData = plot.querySelector(".observable"), ticks = plot.querySelector(".models");
  const told = plot.querySelector("output");
  fill(pickData, content.data.map((d) => d.name));
  const names = Object.keys(content.data[0].models);
  names.forEach((name, k) => {
    const label = document.createElement("label"), box = document.createElement("input"), key = document.createElement("span");
    box.type = "checkbox";
    box.value = name;
    box.checked = k < 2;
    key.className = "key";
    key.style.background = SERIES[k];
    label.append(box, key, name);
    ticks.append(label);
    box.onchange = () => drawData();
  });
  let chosen = -1, spots = [];
  const kindNow = () => content.data[pickData.selectedIndex];
  const left = (d, model, k) => {
    let x = d.y[k] - d.models[model][k];
    if (d.period) x -= d.period * Math.round(x / d.period);
    return x / d.error[k];
  };
  const drawData = () => {
    const d = kindNow(), high = 300, low = 130, gap = 16;
    const [context, wide] = fitted(sheet, high + low + gap + 52);
    const on = [...ticks.querySelectorAll("input:checked")].map((box) => box.value);
    const ink = css("--ink"), soft = css("--soft"), line = css("--line"), from = 54, to = wide - 12;
    const most = Math.max(...d.x) * 1.03, x = (v) => from + (to - from) * v / most;
    const all = d.y.flatMap((y, k) => [y - d.error[k], y + d.error[k]]).concat(on.flatMap((m) => d.models[m]));
    const ends = [all.reduce((a, b) => Math.min(a, b)), all.reduce((a, b) => Math.max(a, b))];
    const pad = 0.05 * (ends[1] - ends[0]) || 0.01, y0 = ends[0] - pad, y1 = ends[1] + pad;
    const y = (v) => 8 + (high - 8) * (1 - (v - y0) / (y1 - y0));
    const sigmas = on.flatMap((m) => d.x.map((_, k) => Math.abs(left(d, m, k)))).sort((a, b) => a - b);
    const s1 = Math.max(4, 1.08 * (sigmas[sigmas.length - 1] || 0));
    // Linear to 4 sigma, the rest by logarithm: both a good fit and a bad one can be read.
    const bent = (s) => Math.sign(s) * (Math.abs(s) <= 4 ? Math.abs(s) : 4 + 4 * Math.log(Math.abs(s) / 4));
    const base = high + gap, r = (s) => base + low * (0.5 - 0.5 * bent(s) / bent(s1));
    const rule = (place, text) => {
      context.strokeStyle = line;
      context.lineWidth = 1;
      context.beginPath(); context.moveTo(from, place); context.lineTo(to, place); context.stroke();
      context.fillStyle = ink;
      context.textAlign = "right";
      context.textBaseline = "middle";
      context.fillText(text, from - 5, place);
    };
    for (const v of steps(y0, y1, 6)) rule(y(v), tick(v));
    for (const s of [-4, 0, 4]) rule(r(s), `${s}`.replace("-", "−") + "σ");
    if (s1 > 10) for (const s of [-1, 1]) rule(r(s * Math.floor(s1)), `${s < 0 ? "−" : ""}${Math.floor(s1)}σ`);
    context.strokeStyle = soft;
    context.strokeRect(from, 8, to - from, high - 8);
    context.strokeRect(from, base, to - from, low);
    context.fillStyle = ink;
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const v of steps(0, most, 6)) context.fillText(tick(v), x(v), base + low + 4);
    context.fillText(d.axis, 0.5 * (from + to), base + low + 22);
    context.save();
    context.textAlign = "left";
    context.fillText(`${d.name}${d.unit ? ` (${d.unit})` : ""}`, from + 6, 12);
    context.restore();
    spots = d.x.map((v, k) => [x(v), y(d.y[k])]);
    context.strokeStyle = context.fillStyle = ink;
    d.x.forEach((v, k) => {
      context.beginPath();
      context.moveTo(x(v), y(d.y[k] - d.error[k])); context.lineTo(x(v), y(d.y[k] + d.error[k])); context.stroke();
      context.beginPath(); context.arc(x(v), y(d.y[k]), 2.2, 0, 7); context.fill();
    });
    for (const model of on) {
      context.fillStyle = context.strokeStyle = SERIES[names.indexOf(model)];
      d.x.forEach((v, k) => {
        const shift = 2 * (on.indexOf(model) - 0.5 * (on.length - 1));
        context.strokeRect(x(v) + shift - 3, y(d.models[model][k]) - 3, 6, 6);
        context.beginPath(); context.arc(x(v) + shift, r(left(d, model, k)), 2.4, 0, 7); context.fill();
      });
    }
    if (chosen >= 0) {
      context.strokeStyle = ink;
      context.lineWidth = 2;
      context.beginPath(); context.arc(...spots[chosen], 8, 0, 7); context.stroke();
    }
    readData(d, on);
  };
  const readData = (d, on) => {
    const shown = d.x.length < d.n ? ` (${d.x.length} of ${d.n} are drawn)` : "";
    if (chosen < 0) {
      const fits = on.map((m) => {
        const worst = d.x.reduce((a, _, k) => Math.max(a, Math.abs(left(d, m, k))), 0);
        return `${m} ${plain(worst, 2)} σ`;
      });
      told.textContent = `${d.n} ${d.name}${shown}.${on.length ? ` Largest residual: ${fits.join(", ")}.` : ""}`;
      return;
    }
    const models = on.map((m) => `${m} ${plain(d.models[m][chosen], 4)}${d.unit} (${plain(left(d, m, chosen), 2)} σ)`);
    told.textContent = `${d.label[chosen]}: ${measured(d.y[chosen], d.error[chosen])}${d.unit}; ${models.join("; ")}`;
  };
  sheet.addEventListener("pointermove", (event) => {
    const box = sheet.getBoundingClientRect(), far = spots.map(([px, py]) =>
      Math.hypot(px - event.clientX + box.left, py - event.clientY + box.top));
    const nearest = far.indexOf(Math.min(...far));
    chosen = far[nearest] < 30 ? nearest : -1;
    drawData();
  });
  sheet.addEventListener("keydown", (event) => {
    const way = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!way) return;
    event.preventDefault();
    const order = kindNow().x.map((v, k) => [v, k]).sort((a, b) => a[0] - b[0]).map((pair) => pair[1]);
    chosen = order[(order.indexOf(chosen) + way + order.length) % order.length];
    drawData();
  });
  pickData.onchange = () => { chosen = -1; drawData(); };

  const draw = () => { drawMap(); drawData(); };
  let wide = root.clientWidth;
  draw();
  new ResizeObserver(() => { if (root.clientWidth !== wide) { wide = root.clientWidth; draw(); } }).observe(root);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
})();
