// Reads the container of a film; stages/core/player/container.py describes and writes it.

export async function unpack(base64) {
  const bytes = Uint8Array.from(atob(base64.trim()), (c) => c.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(inflated).arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const { arrays, ...header } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  header.arrays = {};
  for (const [name, array] of Object.entries(arrays))
    header.arrays[name] = values(new Uint8Array(buffer, 4 + length + array.offset), array);
  return header;
}

// Row after row, as Float32Array.
function values(bytes, { rows, columns, planes, low, step, delta, float }) {
  const count = rows * columns, out = new Float32Array(count), bits = new Uint32Array(out.buffer), modulus = 256 ** planes;
  for (let c = 0; c < columns; c++) {
    const offset = low[c % low.length], scale = step[c % low.length];
    for (let r = 0, before = 0; r < rows; r++) {
      let q = 0;
      for (let plane = 0; plane < planes; plane++) q += bytes[plane * count + c * rows + r] << (8 * plane);
      if (delta) before = q = (before + q) % modulus;
      if (float) bits[r * columns + c] = q; else out[r * columns + c] = offset + scale * q;
    }
  }
  return out;
}
