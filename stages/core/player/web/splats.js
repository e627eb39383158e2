// Draws the Gaussians of a film with WebGL2: one pass projects them (transform feedback), one draws a quad for each.

import { Occluders } from "player/shadows.js";
import { BLEND, COVER, PICK, PRESENT, PROJECT, QUAD } from "player/shaders.js";

const NEAREST = 0.01; // Gaussians with a smaller depth are left out, as by stages/core/raster
const TEXTURE_WIDTH = 4096; // texel() in the shaders
export const MODES = ["photo colours", "objects", "depth", "displacement"];

export class SplatRenderer {
  constructor(canvas, film, reach) {
    const gl = (this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" }));
    if (!gl) throw new Error("This page needs WebGL2, which this browser does not offer.");
    this.canvas = canvas;
    this.float = gl.getExtension("EXT_color_buffer_float") !== null;
    this.background = film.background;
    this.reach = reach;
    this.mode = 0;
    this.light = film.light;
    this.occluders = film.light ? new Occluders(film) : null;
    this.shadows = true;
    this.casters = 0;
    this.hidden = new Set();
    this.count = film.arrays.opacities.length;
    this.range = [NEAREST, 1];
    this.programs = {
      project: program(gl, PROJECT, "#version 300 es\nvoid main() {}", ["splat", "axes", "paint"]),
      blend: program(gl, QUAD, BLEND),
      pick: program(gl, QUAD, PICK),
      present: program(gl, COVER, PRESENT),
    };
    this.upload(film.arrays);
    this.order = gl.createBuffer();
    this.drawn = 0; // Gaussians in the order
    const rows = Math.max(1, Math.ceil(3 * this.count / TEXTURE_WIDTH));
    this.splats = gl.createBuffer(); // written by the projection and copied to a texture, which the quads read
    this.splatRows = rows;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.splats);
    gl.bufferData(gl.ARRAY_BUFFER, 16 * rows * TEXTURE_WIDTH, gl.DYNAMIC_COPY);
    this.splatTexture = this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, new Float32Array(4 * rows * TEXTURE_WIDTH));
    this.orderInput = this.inputs(() => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
      const at = gl.getAttribLocation(this.programs.project.id, "gaussian");
      gl.enableVertexAttribArray(at);
      gl.vertexAttribIPointer(at, 1, gl.UNSIGNED_INT, 4, 0);
    });
    this.quadInput = this.inputs(() => {
      const corners = new Uint32Array(6 * this.count);
      for (let i = 0; i < this.count; i++) corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 1, 4 * i + 2, 4 * i + 3], 6 * i);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    });
    this.nothing = gl.createVertexArray();
    this.feedback = gl.createTransformFeedback();
    this.target = this.makeTarget(this.float ? gl.RGBA16F : gl.RGBA8);
    this.probe = this.makeTarget(gl.RGBA32UI);
    this.resize(this.probe, 1, 1);
  }

  inputs(describe) {
    const array = this.gl.createVertexArray();
    this.gl.bindVertexArray(array);
    describe();
    this.gl.bindVertexArray(null);
    return array;
  }

  upload(a) {
    const gl = this.gl, n = this.count, bands = [0, 1, 2, 3].filter((l) => a[`harmonics${l}`]);
    const gaussians = new Float32Array(12 * n), k = (this.coefficients = bands.length ** 2), sh = new Float32Array(4 * k * n);
    for (let i = 0; i < n; i++) {
      gaussians.set(a.means.subarray(3 * i, 3 * i + 3), 12 * i);
      gaussians[12 * i + 3] = a.opacities[i];
      gaussians.set(a.quats.subarray(4 * i, 4 * i + 4), 12 * i + 4);
      for (let j = 0; j < 3; j++) gaussians[12 * i + 8 + j] = Math.exp(a.scales[3 * i + j]);
      gaussians[12 * i + 11] = a.object_id[i];
      for (const l of bands) {
        const columns = 3 * (2 * l + 1);
        for (let j = 0; j < columns; j++)
          sh[4 * (k * i + l * l + Math.floor(j / 3)) + j % 3] = a[`harmonics${l}`][columns * i + j];
      }
    }
    const weights = a.binding_weight || [];
    this.bound = weights.length / 8;
    const bindings = new Uint32Array(8 * this.bound);
    for (let i = 0; i < this.bound; i++) for (let j = 0; j < 8; j++) {
      bindings[8 * i + (j >> 1)] |= a.binding_index[8 * i + j] << (16 * (j & 1));
      bindings[8 * i + 4 + (j >> 2)] |= Math.round(255 * weights[8 * i + j]) << (8 * (j & 3));
    }
    this.textures = {
      gaussians: this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, gaussians),
      harmonics: this.texture(gl.RGBA16F, gl.RGBA, gl.FLOAT, sh),
      bindings: this.texture(gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, bindings),
      motion: this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, new Float32Array(4)),
      objects: this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, new Float32Array(4)),
      occluders: this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, new Float32Array(4)),
      restIrradiance: this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, a.rest_irradiance ?? new Float32Array(4)),
    };
  }

  // A texture of four values a texel, TEXTURE_WIDTH texels a row.
  texture(format, layout, type, values, texture = this.gl.createTexture()) {
    const gl = this.gl, rows = Math.max(1, Math.ceil(values.length / 4 / TEXTURE_WIDTH));
    const limit = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (rows > limit) throw new Error(`This scene is too large for this graphics processor (${rows} rows of ${limit}).`);
    const padded = new values.constructor(4 * rows * TEXTURE_WIDTH);
    padded.set(values);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, TEXTURE_WIDTH, rows, 0, layout, type, padded);
    for (const parameter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, parameter, gl.NEAREST);
    return texture;
  }

  makeTarget(format) {
    const gl = this.gl;
    return { format, texture: gl.createTexture(), framebuffer: gl.createFramebuffer(), width: 0, height: 0 };
  }

  resize(target, width, height) {
    if (target.width === width && target.height === height) return;
    const gl = this.gl, integer = target.format === gl.RGBA32UI;
    Object.assign(target, { width, height });
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    const type = integer ? gl.UNSIGNED_INT : target.format === gl.RGBA8 ? gl.UNSIGNED_BYTE : gl.HALF_FLOAT;
    gl.texImage2D(gl.TEXTURE_2D, 0, target.format, width, height, 0, integer ? gl.RGBA_INTEGER : gl.RGBA, type, null);
    const filter = integer ? gl.NEAREST : gl.LINEAR;
    for (const parameter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, parameter, filter);
    for (const parameter of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, parameter, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
  }

  setOrder({ order, near, far, motion, spheres }) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.drawn = order.length;
    this.range = [near, Math.max(far, near + 1e-6)];
    if (motion) this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, motion, this.textures.motion);
    if (spheres) this.occluders.centres = spheres;
    if (spheres) this.setOccluders();
  }

  setOccluders() {
    const gl = this.gl, { values, count } = this.occluders.texels(this.hidden);
    this.casters = count;
    this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, values, this.textures.occluders);
  }

  // rows: for each object id from 0 the flat colour, and 0 hidden, 1 shown or 2 highlighted
  setObjects(rows) {
    const gl = this.gl;
    this.hidden = new Set(rows.flatMap((row, id) => row[3] === 0 ? [id] : []));
    if (this.occluders) this.setOccluders();
    this.texture(gl.RGBA32F, gl.RGBA, gl.FLOAT, Float32Array.from(rows.flat()), this.textures.objects);
  }

  // Splats of all Gaussians in the order, for a view {rotation, translation, eye, intrinsics, size}.
  project(view) {
    const gl = this.gl, { id, at } = this.programs.project;
    gl.useProgram(id);
    for (const [i, name] of Object.keys(this.textures).entries()) {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[name]);
      gl.uniform1i(at(name), i);
    }
    gl.uniform1ui(at("bound"), this.bound);
    gl.uniform1ui(at("coefficients"), this.coefficients);
    gl.uniformMatrix3fv(at("rotation"), true, view.rotation);
    gl.uniform3fv(at("translation"), view.translation);
    gl.uniform3fv(at("eye"), view.eye);
    gl.uniform3f(at("depths"), NEAREST, ...this.range);
    gl.uniform4fv(at("intrinsics"), view.intrinsics);
    gl.uniform2fv(at("size"), view.size);
    gl.uniform1i(at("mode"), this.mode);
    gl.uniform1f(at("reach"), this.reach);
    gl.uniform1i(at("casters"), this.shadows ? this.casters : 0);
    if (this.light) {
      gl.uniform4f(at("light"), this.light.sky, this.light.lamp, this.light.spread, this.light.beneath);
      gl.uniform3fv(at("lamp"), this.light.direction);
    }
    gl.bindVertexArray(this.orderInput);
    gl.bindBuffer(gl.ARRAY_BUFFER, null); // the splats may have one use at a time
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.splats);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.drawn);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, this.splats);
    gl.bindTexture(gl.TEXTURE_2D, this.splatTexture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, this.splatRows, gl.RGBA, gl.FLOAT, 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
  }

  quads({ id, at }, view) {
    const gl = this.gl;
    gl.useProgram(id);
    gl.bindTexture(gl.TEXTURE_2D, this.splatTexture);
    gl.uniform1i(at("splats"), 0);
    gl.uniform2fv(at("size"), view.size);
    gl.bindVertexArray(this.quadInput);
    gl.drawElements(gl.TRIANGLES, 6 * this.drawn, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }

  // The picture of a view, in `target`.
  paint(view) {
    const gl = this.gl, [width, height] = view.size;
    this.resize(this.target, width, height);
    this.project(view);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.quads(this.programs.blend, view);
    gl.disable(gl.BLEND);
  }

  // Draw a view on the canvas; its size may be smaller than the canvas's.
  draw(view) {
    this.paint(view);
    this.present(null, this.canvas.width, this.canvas.height);
  }

  present(framebuffer, width, height) {
    const gl = this.gl, { id, at } = this.programs.present;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, width, height);
    gl.useProgram(id);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.uniform1i(at("picture"), 0);
    gl.uniform3fv(at("background"), this.background);
    gl.uniform2f(at("scale"), 1 / width, 1 / height);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }

  // The pixels of a view as bytes RGBA, the top row first.
  pixels(view) {
    const gl = this.gl, [width, height] = view.size, out = this.makeTarget(gl.RGBA8);
    this.paint(view);
    this.resize(out, width, height);
    this.present(out.framebuffer, width, height);
    const bytes = new Uint8Array(4 * width * height), flipped = new Uint8Array(bytes.length);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    for (let y = 0; y < height; y++)
      flipped.set(bytes.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
    gl.deleteTexture(out.texture);
    gl.deleteFramebuffer(out.framebuffer);
    return flipped;
  }

  // The Gaussian in front at a pixel of a view, {gaussian, depth}, or null.
  pick(view, x, y) {
    const gl = this.gl, [width, height] = view.size;
    this.project(view);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.probe.framebuffer);
    gl.viewport(-Math.floor(x), Math.floor(y) + 1 - height, width, height);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    this.quads(this.programs.pick, view);
    const found = new Uint32Array(4);
    gl.readPixels(0, 0, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    return found[0] ? { gaussian: found[0] - 1, depth: new Float32Array(found.buffer)[1] } : null;
  }
}

function program(gl, vertex, fragment, outputs) {
  const id = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(id, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
  }
  if (outputs) gl.transformFeedbackVaryings(id, outputs, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(id);
  if (!gl.getProgramParameter(id, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(id));
  const places = new Map();
  const at = (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(id, name));
    return places.get(name);
  };
  return { id, at };
}
