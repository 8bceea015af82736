// Models to turn, in plain WebGL. Every figure of class "viewer" carries its model as JSON (model.py):
// quantised positions, normals and faces, layers of colours to choose from, lines, labels.
"use strict";
(() => {
  const MESH = [
    `attribute vec3 position; attribute vec3 normal; attribute vec3 colour;
     uniform mat4 clip; uniform vec3 low; uniform float step; uniform float size; varying vec3 n; varying vec3 c; varying vec3 at;
     void main() { vec3 p = low + step * position; n = normal; c = colour; at = p; gl_PointSize = size; gl_Position = clip * vec4(p, 1.0); }`,
    // A lamp at the viewer's shoulder and a weaker one opposite; what faces away is seen from inside.
    `precision mediump float; varying vec3 n; varying vec3 c; varying vec3 at; uniform vec3 eye; uniform vec3 lamp;
     uniform float plain;
     void main() { vec3 m = normalize(n); vec3 v = normalize(eye - at); m = dot(m, v) < 0.0 ? -m : m;
       float lit = 0.36 + 0.52 * max(dot(m, lamp), 0.0) + 0.16 * max(dot(m, v), 0.0);
       gl_FragColor = vec4(c * mix(lit, 1.0, plain), 1.0); }`,
  ];
  const LINES = [
    `attribute vec3 position; attribute vec3 colour; uniform mat4 clip; uniform vec3 low; uniform float step;
     varying vec3 c; void main() { c = colour; gl_Position = clip * vec4(low + step * position, 1.0); }`,
    `precision mediump float; varying vec3 c; void main() { gl_FragColor = vec4(c, 1.0); }`,
  ];
  const FIELD = 0.5; // of view, radians, upright

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const words = (text) => new Uint16Array(bytes(text).buffer);
  const minus = (a, b) => a.map((x, k) => x - b[k]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

  function program(gl, [vertex, fragment]) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  function buffer(gl, data, kind = gl.ARRAY_BUFFER) {
    const made = gl.createBuffer();
    gl.bindBuffer(kind, made);
    gl.bufferData(kind, data, gl.STATIC_DRAW);
    return made;
  }

  function feed(gl, shader, name, data, type, normalised) {
    const place = gl.getAttribLocation(shader, name);
    if (place < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, data);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, type, normalised, 0, 0);
  }

  // Where the viewer stands: azimuth from x towards y and elevation (radians), looking at a target.
  function eyeAndAxes(view) {
    const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
    const back = [ce * ca, ce * sa, se], right = [-sa, ca, 0];
    const eye = view.target.map((x, k) => x + view.distance * back[k]);
    return { eye, right, up: cross(back, right), back };
  }

  function clipMatrix(view, aspect) {
    const { eye, right, up, back } = eyeAndAxes(view);
    const near = view.distance / 50, far = view.distance + 4 * view.size, zoom = 1 / Math.tan(FIELD / 2);
    const rows = [
      [...right, -dot(right, eye)].map((x) => (x * zoom) / aspect),
      [...up, -dot(up, eye)].map((x) => x * zoom),
      [...back, -dot(back, eye)].map((x, k) => (x * (far + near)) / (near - far) + (k === 3 ? (2 * far * near) / (near - far) : 0)),
      [...back, -dot(back, eye)].map((x) => -x),
    ];
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  function upload(gl, model) {
    const parts = { layers: [] };
    if (model.positions) {
      parts.mesh = program(gl, MESH);
      const positions = words(model.positions);
      parts.points = positions.length / 3;
      parts.positions = buffer(gl, positions);
      parts.normals = buffer(gl, new Int8Array(bytes(model.normals).buffer));
      parts.layers = model.layers.map((layer) => buffer(gl, bytes(layer.colours)));
    }
    if (model.faces) {
      const corners = words(model.faces);
      parts.corners = corners.length;
      parts.faces = buffer(gl, corners, gl.ELEMENT_ARRAY_BUFFER);
    }
    if (model.lines) {
      parts.line = program(gl, LINES);
      const ends = words(model.lines.positions);
      parts.ends = ends.length / 3;
      parts.linePositions = buffer(gl, ends);
      parts.lineColours = buffer(gl, bytes(model.lines.colours));
    }
    return parts;
  }

  function frame(gl, shader, model, clip) {
    gl.useProgram(shader);
    gl.uniformMatrix4fv(gl.getUniformLocation(shader, "clip"), false, clip);
    gl.uniform3fv(gl.getUniformLocation(shader, "low"), model.low);
    gl.uniform1f(gl.getUniformLocation(shader, "step"), model.step);
  }

  function paint(gl, parts, model, view, layer) {
    const { eye, right, up, back } = eyeAndAxes(view);
    const clip = clipMatrix(view, gl.canvas.width / gl.canvas.height);
    gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    if (parts.mesh) {
      frame(gl, parts.mesh, model, clip);
      const lamp = [0, 1, 2].map((k) => 0.35 * right[k] + 0.45 * up[k] + 0.82 * back[k]);
      gl.uniform3fv(gl.getUniformLocation(parts.mesh, "eye"), eye);
      gl.uniform3fv(gl.getUniformLocation(parts.mesh, "lamp"), lamp);
      gl.uniform1f(gl.getUniformLocation(parts.mesh, "plain"), model.layers[layer].unlit ? 0.8 : 0.0);
      feed(gl, parts.mesh, "position", parts.positions, gl.UNSIGNED_SHORT, false);
      feed(gl, parts.mesh, "normal", parts.normals, gl.BYTE, true);
      feed(gl, parts.mesh, "colour", parts.layers[layer], gl.UNSIGNED_BYTE, true);
      // Points of a coarse cloud lie some 8 mm apart: squares of that size close the surface.
      gl.uniform1f(gl.getUniformLocation(parts.mesh, "size"), Math.max(2, (8 * gl.canvas.height) / (2 * view.distance * Math.tan(FIELD / 2))));
      if (parts.faces) {
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, parts.faces);
        gl.drawElements(gl.TRIANGLES, parts.corners, gl.UNSIGNED_SHORT, 0);
      } else gl.drawArrays(gl.POINTS, 0, parts.points);
    }
    if (parts.line) {
      frame(gl, parts.line, model, clip);
      feed(gl, parts.line, "position", parts.linePositions, gl.UNSIGNED_SHORT, false);
      feed(gl, parts.line, "colour", parts.lineColours, gl.UNSIGNED_BYTE, true);
      gl.drawArrays(gl.LINES, 0, parts.ends);
    }
    return clip;
  }

  function placeLabels(host, model, clip) {
    model.labels.forEach(([, ...at], k) => {
      const p = [0, 1, 2, 3].map((r) => clip[r] * at[0] + clip[4 + r] * at[1] + clip[8 + r] * at[2] + clip[12 + r]);
      const [x, y] = [(p[0] / p[3] + 1) / 2, (1 - p[1] / p[3]) / 2];
      const span = host.children[k];
      span.style.display = p[3] > 0 ? "" : "none";
      span.style.transform = `translate(${x * host.clientWidth + 6}px, ${y * host.clientHeight - 18}px)`;
    });
  }

  function element(name, content, host) {
    const made = document.createElement(name);
    made.textContent = content;
    host.append(made);
    return made;
  }

  function showLegend(host, legend) {
    host.replaceChildren();
    if (!legend) return;
    if (legend.caption) element("div", legend.caption, host);
    for (const [colour, text] of legend.swatches || []) {
      const row = element("div", text, host), swatch = element("span", "", row);
      swatch.className = "swatch";
      swatch.style.background = colour;
      row.prepend(swatch);
    }
    if (legend.gradient) {
      const bar = element("div", "", host), ends = element("div", "", host);
      bar.className = "bar";
      ends.className = "ends";
      bar.style.background = `linear-gradient(to right, ${legend.gradient.join(",")})`;
      for (const end of legend.ends) element("span", end, ends);
    }
  }

  // Mouse, touch and pen alike: one pointer turns, two move and zoom, Shift moves, the wheel zooms.
  function steer(canvas, view, home, changed) {
    const down = new Map();
    const middle = () => [0, 1].map((k) => [...down.values()].reduce((sum, p) => sum + p[k], 0) / down.size);
    const apart = () => { const [a, b] = [...down.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const turn = (dx, dy) => {
      view.azimuth -= 0.008 * dx;
      view.elevation = clamp(view.elevation + 0.008 * dy, -1.55, 1.55);
    };
    const move = (dx, dy) => {
      const { right, up } = eyeAndAxes(view), scale = (2 * view.distance * Math.tan(FIELD / 2)) / canvas.clientHeight;
      view.target = view.target.map((x, k) => x + scale * (up[k] * dy - right[k] * dx));
    };
    const zoom = (times) => { view.distance = clamp(view.distance * times, 0.02 * home.distance, 6 * home.distance); };
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); down.set(e.pointerId, [e.clientX, e.clientY]); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => down.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      if (!down.has(e.pointerId)) return;
      const before = middle(), gap = down.size === 2 ? apart() : 0;
      down.set(e.pointerId, [e.clientX, e.clientY]);
      const after = middle();
      (down.size > 1 || e.shiftKey ? move : turn)(after[0] - before[0], after[1] - before[1]);
      if (gap) zoom(gap / Math.max(apart(), 1));
      changed();
    });
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(0.0015 * e.deltaY)); changed(); }, { passive: false });
    canvas.addEventListener("dblclick", () => { Object.assign(view, home, { target: [...home.target] }); changed(); });
    canvas.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [-15, 0], ArrowRight: [15, 0], ArrowUp: [0, -15], ArrowDown: [0, 15] }[e.key];
      if (step) turn(...step);
      else if (e.key === "+" || e.key === "-") zoom(e.key === "+" ? 0.9 : 1.1);
      else return;
      e.preventDefault();
      changed();
    });
  }

  function start(figure, model) {
    const canvas = figure.querySelector("canvas");
    const [labels, buttons, legend] = ["labels", "layers", "legend"].map((name) => figure.querySelector(`.${name}`));
    // The picture is kept, so that it can be printed.
    const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true, antialias: true });
    if (!gl) {
      element("p", model.failed || "This browser shows no WebGL: the pictures show the same.", canvas.parentElement).className = "failed";
      return;
    }
    const home = { ...model.view, distance: (0.54 * model.view.size) / Math.tan(FIELD / 2) };
    const view = { ...home, target: [...home.target] };
    let parts = upload(gl, model), layer = 0, waiting = false;
    const draw = () => {
      waiting = false;
      if (!canvas.isConnected) return;
      const sharp = window.devicePixelRatio || 1;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * sharp)));
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      placeLabels(labels, model, paint(gl, parts, model, view, layer));
    };
    const changed = () => { if (!waiting) requestAnimationFrame(draw); waiting = true; };
    const choose = (number) => {
      layer = number;
      [...buttons.children].forEach((button, k) => button.setAttribute("aria-pressed", k === number));
      showLegend(legend, model.layers[number].legend);
      changed();
    };
    model.labels.forEach(([text]) => element("span", text, labels));
    if (model.layers.length > 1) model.layers.forEach((one, k) => element("button", one.name, buttons).addEventListener("click", () => choose(k)));
    steer(canvas, view, home, changed);
    new ResizeObserver(changed).observe(canvas);
    if (figure.dataset.turning) {  // by itself until a person takes it
      // Drawn without a graphics card it takes a core, which a scan needs: five pictures a second then.
      const drawer = gl.getExtension("WEBGL_debug_renderer_info");
      const pause = drawer && /swiftshader|llvmpipe|software/i.test(gl.getParameter(drawer.UNMASKED_RENDERER_WEBGL)) ? 200 : 40;
      const again = () => { if (!canvas.isConnected || !figure.dataset.turning) return; view.azimuth -= 0.0003 * pause; changed(); setTimeout(again, pause); };
      canvas.addEventListener("pointerdown", () => { delete figure.dataset.turning; });
      again();
    }
    canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { parts = upload(gl, model); changed(); });
    window.addEventListener("beforeprint", draw);
    choose(0);
  }

  // A page whose figures have no model yet shows them by this; a figure is shown anew with another canvas.
  window.showModel = start;
  document.querySelectorAll("figure.viewer").forEach((figure) => {
    const script = figure.querySelector("script");
    if (script) start(figure, JSON.parse(script.textContent));
  });
})();
