// One texel per pixel: no sampler, no filter, no blending. A texture of one column, one row or one texel stands for
// pictures that change along one axis or none.

@group(0) @binding(0) var picture: texture_2d<f32>;

@vertex
fn whole_surface(@builtin(vertex_index) corner: u32) -> @builtin(position) vec4<f32> {
    let x = f32(i32(corner & 1u) * 4 - 1);
    let y = f32(i32(corner >> 1u) * 4 - 1);
    return vec4<f32>(x, y, 0.0, 1.0);
}

@fragment
fn texel(@builtin(position) centre: vec4<f32>) -> @location(0) vec4<f32> {
    let last = textureDimensions(picture) - vec2<u32>(1u, 1u);
    return vec4<f32>(textureLoad(picture, min(vec2<u32>(centre.xy), last), 0).rgb, 1.0);
}
