// The 3D view: unpacks the scene, gives it to K3D, and connects the controls. All coordinates have z up.
"use strict";
(async () => {
  const root = document.getElementById("map3d-root");
  const stage = root.querySelector(".stage"), tools = root.querySelector(".tools");
  const chosen = root.querySelector(".chosen"), status = root.querySelector(".status");
  const text = (id) => document.getElementById(id).textContent;
  const fail = (reason) => {
    root.classList.add("unavailable");
    status.textContent = `The 3D view is not available: ${reason}. The rest of the page does not need it.`;
  };
  if (!("DecompressionStream" in window)) return fail("this browser is older than 2023");
  const probe = document.createElement("canvas").getContext("webgl2");
  if (!probe) return fail("this browser has no WebGL 2");
  const named = probe.getExtension("WEBGL_debug_renderer_info");
  const inSoftware = named && /swiftshader|llvmpipe|software/i.test(probe.getParameter(named.UNMASKED_RENDERER_WEBGL));

  const unzip = async (id) => {
    const code = atob(text(id)), bytes = new Uint8Array(code.length);
    for (let i = 0; i < code.length; i++) bytes[i] = code.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  };

  const header = JSON.parse(text("map3d-header"));
  const block = await unzip("map3d-block");
  const types = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };
  const array = (name) => {
    if (!(name in header.arrays)) return null;
    const [type, start, size] = header.arrays[name];
    return new types[type](block, start, size);
  };
  let library;
  const source = new TextDecoder().decode(await unzip("map3d-library"));
  new Function("define", source)((name, needs, make) => { library = make(); });

  // The points are shuffled, so that the first part of them, drawn while the map turns, covers the whole map.
  const count = header.points, order = new Uint32Array(count).map((_, i) => i);
  for (let i = count - 1, seed = 1; i > 0; i--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const j = Math.floor((seed / 4294967296) * (i + 1)), kept = order[i];
    order[i] = order[j];
    order[j] = kept;
  }
  const placed = (name, [low, step], size, row = (i) => i) => {
    const whole = array(name), found = new Float32Array(3 * size);
    for (let i = 0; i < size; i++) for (let k = 0; k < 3; k++) found[3 * i + k] = low[k] + step[k] * whole[3 * row(i) + k];
    return found;
  };
  const hex = (r, g, b) => (r << 16) | (g << 8) | b;
  const palette = array("palette"), shade = (s) => hex(palette[3 * s], palette[3 * s + 1], palette[3 * s + 2]);
  const coloured = (name, size, row = (i) => i) => {
    const rgb = array(name), found = new Uint32Array(size);
    for (let i = 0; i < size; i++) { const j = 3 * row(i); found[i] = hex(rgb[j], rgb[j + 1], rgb[j + 2]); }
    return found;
  };
  const level = (values, share) => Float32Array.from(values).sort()[Math.floor(share * (values.length - 1))];
  const positions = placed("points", header.box, count, (i) => order[i]);
  const heights = new Float32Array(count).map((_, i) => positions[3 * i + 2]);
  const path = array("path"), cameras = array("cameras"), confidence = array("confidence");
  const floor = count ? level(heights, 0.02) : 0, ceiling = count ? level(heights, 0.98) : 1;
  const byHeight = (z) => shade(Math.round(255 * Math.min(1, Math.max(0, (z - floor) / (ceiling - floor || 1)))));
  const colours = {
    image: () => coloured("colours", count, (i) => order[i]),
    height: () => new Uint32Array(count).map((_, i) => byHeight(heights[i])),
    confidence: () => new Uint32Array(count).map((_, i) => shade(confidence[order[i]])),
  };

  const own = getComputedStyle(document.documentElement);
  const ink = (name) => parseInt(own.getPropertyValue(name).trim().slice(1), 16);
  const k3d = new library.K3D(library.ThreeJsProvider, stage, {
    menuVisibility: false, gridVisible: false, axesHelper: 0, antialias: inSoftware ? 0 : 1, logarithmicDepthBuffer: false,
    cameraMode: "orbit", cameraUpAxis: "z", cameraAutoFit: false, clearColor: ink("--page"), cameraFov: 50,
    cameraDampingFactor: 0,
  });
  const world = k3d.getWorld();
  const unit4 = { data: new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), shape: [4, 4] };
  const POINTS = 1, MESH = 2, PATH = 3, TRUTH = 4, SIGMA = 5, CAMERAS = 6, CHOSEN = 7;
  const objects = [];
  const add = (id, type, values) => objects.push({ id, type, visible: true, opacity: 1, model_matrix: unit4, ...values });
  const line = (id, vertices, color) => {
    if (vertices && vertices.length >= 6) {
      add(id, "Line", { vertices: { data: vertices, shape: [vertices.length / 3, 3] }, color, shader: "thick", width: 0.002 * header.extent });
    }
  };
  const rays = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
  const frustums = (id, vertices, color) => {
    const number = vertices.length / 15, indices = new Uint32Array(16 * number);
    for (let i = 0; i < number; i++) rays.forEach((corner, k) => { indices[16 * i + k] = 5 * i + corner; });
    if (number) {
      add(id, "Lines", { vertices: { data: vertices, shape: [5 * number, 3] }, indices: { data: indices, shape: [indices.length] }, indices_type: "segment", color, shader: "simple", width: 0.001 });
    }
  };
  const cloud = { positions: { data: positions, shape: [count, 3] }, colors: { data: colours.image(), shape: [count] }, color: 0xffffff, point_size: header.size, shader: "flat" };
  if (count) add(POINTS, "Points", cloud);
  if (header.mesh_box) {
    const size = header.arrays.vertices[2] / 3, faces = array("faces");
    add(MESH, "Mesh", {
      vertices: { data: placed("vertices", header.mesh_box, size), shape: [size, 3] }, indices: { data: faces, shape: [faces.length / 3, 3] },
      colors: { data: coloured("vertex_colours", size), shape: [size] }, color: 0xffffff, side: "double", flat_shading: false, shininess: 0, visible: true,
    });
  }
  line(PATH, path, ink("--blue"));
  line(TRUTH, array("truth"), ink("--green"));
  const known = header.keyframes.map((frame, i) => [frame, i]).filter(([frame]) => frame.sigma !== null);
  if (known.length) {
    const centres = new Float32Array(known.flatMap(([, i]) => Array.from(cameras.slice(15 * i, 15 * i + 3))));
    add(SIGMA, "Points", {
      positions: { data: centres, shape: [known.length, 3] }, color: ink("--orange"), point_size: 1, shader: "3d", opacity: 0.3,
      point_sizes: { data: new Float32Array(known.map(([frame]) => 4 * frame.sigma)), shape: [known.length] }, // a ball of two sigma
    });
  }
  frustums(CAMERAS, cameras, ink("--blue"));
  await k3d.load({ objects });
  const object = (id) => world.ObjectsById[id];

  // While the view moves, the number of drawn points is limited to keep about 30 frames a second. All points are drawn
  // when the camera has not changed for a quarter of a second and, on slow machines, for ten frames.
  let moving = false, budget = Math.min(count, 100000), last = 0, changed = 0, idle = 0;
  const draw = (number) => { // fewer points are larger, so that surfaces stay closed
    if (!object(POINTS)) return;
    object(POINTS).geometry.setDrawRange(0, number);
    object(POINTS).material.size = header.size * Math.min(2, Math.sqrt(count / number));
  };
  const setMoving = (on) => {
    moving = on;
    if (inSoftware) world.renderer.setPixelRatio(on ? 0.5 : 1);
  };
  const pace = (now) => {
    const passed = now - last;
    last = now;
    idle += 1;
    if (idle > 10 && now - changed > 250) {
      setMoving(false);
      draw(count);
      k3d.render();
      return;
    }
    if (passed > 40) budget = Math.max(Math.min(count, 20000), Math.round(budget * 0.8));
    else if (passed < 25) budget = Math.min(count, Math.round(budget * 1.05));
    draw(budget);
    requestAnimationFrame(pace);
  };
  k3d.on(k3d.events.CAMERA_CHANGE, () => {
    idle = 0;
    changed = performance.now();
    if (moving) return;
    setMoving(true);
    last = changed;
    draw(budget);
    requestAnimationFrame(pace);
  });

  const show = (id, on) => { if (object(id)) object(id).visible = on; };
  const offer = (name, there) => { tools.elements[name].closest("label").hidden = !there; };
  const layers = { points: POINTS, mesh: MESH, path: PATH, sigma: SIGMA, truth: TRUTH, cameras: CAMERAS };
  const refresh = () => {
    for (const [name, id] of Object.entries(layers)) show(id, tools.elements[name].checked);
    k3d.render();
  };
  for (const [name, id] of Object.entries(layers)) offer(name, Boolean(object(id)));
  tools.elements.colour.querySelector("[value=confidence]").hidden = !confidence;
  const bottom = count ? level(heights, 0) : 0, top = count ? level(heights, 1) : 1;
  const cutAt = (z) => { k3d.setClippingPlanes(z < top ? [[0, 0, -1, z]] : []); };
  const setCut = (z) => { tools.elements.cut.value = Math.min(1000, Math.round(1000 * (z - bottom) / (top - bottom || 1))); cutAt(z); };
  const repaint = async () => {
    await k3d.reload(world.ObjectsListJson[POINTS], { colors: { data: colours[tools.elements.colour.value](), shape: [count] } });
    refresh();
  };

  tools.addEventListener("submit", (event) => event.preventDefault());
  tools.addEventListener("input", (event) => {
    const name = event.target.name;
    if (name === "colour") { if (count) repaint(); }
    else if (name === "cut") { cutAt(bottom + (top - bottom) * event.target.value / 1000); k3d.render(); }
    else refresh();
  });

  const tick = (names, on) => { for (const name of names) tools.elements[name].checked = on; };
  const home = () => { // from behind the path, looking down on the map
    const [x, y, z] = header.middle, away = Math.hypot(x, y);
    const e = header.extent * Math.max(1, (1.2 * stage.clientHeight) / stage.clientWidth);
    const [dx, dy] = away > 0.1 * header.extent ? [x / away, y / away] : [0.6, 0.8];
    k3d.setCamera([x - 0.68 * e * dx, y - 0.68 * e * dy, z + 0.6 * e, x, y, z, 0, 0, 1]);
    setCut(header.cut);
    tick(["path", "sigma", "truth", "cameras"], true);
    refresh();
  };
  root.querySelector("[data-home]").addEventListener("click", home);

  // Keyframes: the one nearest to a click, within 28 pixels on the screen.
  let current = -1, address = null;
  const ends = array("image_ends"), images = array("images");
  const select = async (index) => {
    current = index;
    if (address) URL.revokeObjectURL(address);
    address = null;
    if (object(CHOSEN)) await k3d.removeObject(CHOSEN);
    chosen.hidden = index < 0;
    if (index < 0) return k3d.render();
    const frame = header.keyframes[index], picture = chosen.querySelector("img");
    picture.hidden = ends[index] === ends[index + 1];
    if (!picture.hidden) {
      address = URL.createObjectURL(new Blob([images.slice(ends[index], ends[index + 1])], { type: "image/jpeg" }));
      picture.src = address;
      picture.alt = `Image of ${frame.name}`;
    }
    const off = frame.sigma === null ? "" : header.unit ? `, ± ${(100 * frame.sigma).toFixed(1)} cm` : `, ± ${frame.sigma.toPrecision(2)}`;
    chosen.querySelector("b").textContent = frame.name;
    chosen.querySelector("span").textContent = `${frame.time.toFixed(2)} s${off}`;
    objects.length = 0;
    frustums(CHOSEN, cameras.slice(15 * index, 15 * index + 15), ink("--red"));
    await k3d.load({ objects });
    k3d.render();
  };
  const onScreen = (i) => {
    const view = world.camera.matrixWorldInverse.elements, lens = world.camera.projectionMatrix.elements;
    const apply = (m, v) => [0, 1, 2, 3].map((row) => m[row] * v[0] + m[4 + row] * v[1] + m[8 + row] * v[2] + m[12 + row] * v[3]);
    const [x, y, , w] = apply(lens, apply(view, [cameras[15 * i], cameras[15 * i + 1], cameras[15 * i + 2], 1]));
    return w <= 0 ? null : [(0.5 + 0.5 * x / w) * stage.clientWidth, (0.5 - 0.5 * y / w) * stage.clientHeight];
  };
  let pressed = null;
  stage.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
  window.addEventListener("pointerup", (event) => {
    const from = pressed, frame = stage.getBoundingClientRect();
    pressed = null;
    if (!from || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 5) return;
    if (!tools.elements.cameras.checked) return;
    let nearest = -1, least = 28;
    header.keyframes.forEach((_, i) => {
      const at = onScreen(i);
      const distance = at ? Math.hypot(event.clientX - frame.left - at[0], event.clientY - frame.top - at[1]) : Infinity;
      if (distance < least) [nearest, least] = [i, distance];
    });
    if (nearest >= 0) select(nearest);
  }, true);
  chosen.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    const number = header.keyframes.length;
    if (button.dataset.step) select((current + Number(button.dataset.step) + number) % number);
    if ("close" in button.dataset) select(-1);
    if ("look" in button.dataset) {
      const c = cameras.slice(15 * current, 15 * current + 15);
      const ahead = [0, 1, 2].map((k) => (c[3 + k] + c[6 + k] + c[9 + k] + c[12 + k]) / 4 - c[k]);
      tick(["path", "sigma", "truth", "cameras"], false); // they would hide what lies ahead
      k3d.setCamera([0, 1, 2].map((k) => c[k]).concat([0, 1, 2].map((k) => c[k] + 3 * ahead[k]), [0, 0, 1]));
      show(CHOSEN, false);
      setCut(Infinity);
      refresh();
    }
  });

  tick(["mesh"], false);
  home();
  const part = header.points < header.of ? ` of ${header.of.toLocaleString("en")}` : "";
  status.textContent = `${count.toLocaleString("en")}${part} points. Drag to turn, wheel or two fingers to zoom, right button or two fingers to move. Click a keyframe for its image. Orange balls: two standard deviations of the position.`;
  window.map3d = { k3d, home, select, onScreen, ready: true };
})().catch((error) => {
  const root = document.getElementById("map3d-root");
  root.classList.add("unavailable");
  root.querySelector(".status").textContent = `The 3D view could not start: ${error.message}. The rest of the page does not need it.`;
});
