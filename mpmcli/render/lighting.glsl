// Parts of the fragment shader of `lighting`, each after a line with its name; finishes have the names of `Finish`.
// In all parts: n, v: normal and direction of the viewer; lamp, sky: shares of light; thick: of what is clear, in units.
//// room
vec3 roomLight(vec3 d, float blur) {
    float rise = dot(d, upwards);
    vec3 c = mix(horizonColor, skyColor, smoothstep(-0.05 - 0.3 * blur, 0.75, rise));
    c = mix(groundColor, c, smoothstep(-0.12 - 0.5 * blur, 0.06 + 0.5 * blur, rise));
    float edge = 0.03 + 0.5 * blur;
    c += lampColor * 2.2 * (1.0 - 0.75 * blur) * smoothstep(0.90 - edge, 0.90 + edge, dot(d, lampTo));
    c += lampColor * 0.8 * (1.0 - 0.75 * blur) * smoothstep(0.86 - edge, 0.86 + edge, dot(d, rimTo));
    return c;
}
vec3 softLight(vec3 n) {
    float rise = 0.5 + 0.5 * dot(n, upwards);
    return mix(0.55 * groundColor, 0.55 * skyColor + 0.35 * horizonColor, rise);
}
float wrapped(float c, float w) { return max((c + w) / (1.0 + w), 0.0); }
float mirror(float c, float f) { return f + (1.0 - f) * pow(1.0 - clamp(c, 0.0, 1.0), 5.0); }
//// common
vec3 n = normalize(worldNormal);
vec3 v = TOWARDS;
vec3 flat_ = step(upperWall - wallGap, worldPoint) - step(worldPoint, lowerWall + wallGap);
bool atWall = WALLED && dot(flat_, flat_) > 0.5;
if (atWall) { n = normalize(flat_); }
float facing = dot(n, v);
if (facing < 0.02) { n = normalize(n + (0.02 - facing) * v); facing = dot(n, v); }
float lamp = carriedLight.x;
float sky = carriedLight.y;
float thick = carriedLight.z / thickUnit;
vec3 base = carriedTint;
vec3 gaps = min(worldPoint - lowerWall, upperWall - worldPoint);
// Where the surface bends into a wall its normals are between the two, and would glint.
float free_ = smoothstep(0.1, 1.5, min(gaps.x, min(gaps.y, gaps.z)) / grainSize);
vec3 color = base;
vec2 here = gl_FragCoord.xy / pictureSize;
//// tone
color = min(color, vec3(8.0));
vec3 over = max(color - 0.7, vec3(0.0));
color = min(color, vec3(0.7)) + 0.3 * over / (over + 0.3);
fragOutput0 = vec4(pow(max(color, vec3(0.0)), vec3(1.0 / 2.2)), 1.0);
//// behind
vec2 bend = -vec2(dot(n, cameraRight), dot(n, cameraUp)) * min(carriedLight.z, thickUnit) * 0.08 * pixelsToMetre;
if (atWall) { bend = vec2(0.0); }
vec2 place = clamp(here + bend / pictureSize, vec2(0.002), vec2(0.998));
vec4 seenBehind = texture(behindTexture, place);
// What stands before the surface is not seen through it.
if (seenBehind.a < (dot(cameraAt - worldPoint, toCamera) - nearAndFar.x) / (nearAndFar.y - nearAndFar.x) - 0.01) {
    seenBehind = texture(behindTexture, here);
}
vec3 behind = pow(seenBehind.rgb, vec3(2.2));
//// matte
color = base * (lampColor * lamp * wrapped(dot(n, lampTo), 0.12) + sky * softLight(n)
        + 0.12 * max(dot(n, fillTo), 0.0) * sky);
color += mirror(facing, 0.04) * 0.35 * sky * roomLight(reflect(-v, n), 0.55);
//// field
color = base * (0.50 + 0.34 * lamp * wrapped(dot(n, lampTo), 0.35) + 0.26 * sky * (0.6 + 0.4 * dot(n, upwards)));
color += 0.06 * mirror(facing, 0.04) * sky;
//// metal
vec3 tinted = base + (1.0 - base) * pow(1.0 - facing, 5.0);
color = tinted * roomLight(reflect(-v, n), 0.22) * mix(0.35, 1.0, sky) * 0.9;
color += base * 0.35 * (lampColor * lamp * max(dot(n, lampTo), 0.0) + sky * softLight(n));
//// crumbly
n = normalize(n + 0.5 * carriedRough);
float grit = 0.95 + 0.10 * carriedRough.x;
vec3 shade = mix(vec3(0.66, 0.78, 1.0), vec3(1.0), clamp(lamp, 0.0, 1.0));
color = base * grit * (0.60 * lampColor * lamp * wrapped(dot(n, lampTo), 0.45)
        + 1.05 * shade * (0.35 + 0.65 * sky) * (0.4 * softLight(n) + 0.6 * softLight(upwards)) + 0.10);
//// translucent
float through = exp(-2.0 * thick);
vec3 pure = base / max(max(base.r, base.g), max(base.b, 1e-3));
vec3 pale = mix(base, pow(base, vec3(0.55)), 0.55);
float round_ = wrapped(dot(n, lampTo), 0.6);
vec3 body = mix(base, pale, 0.25 * round_ + 0.5 * through)
        * (lampColor * (0.35 + 0.65 * lamp) * round_ * 0.62 + (0.35 + 0.65 * sky) * softLight(n) * 0.75);
body += pale * 0.30 * pow(wrapped(dot(n, rimTo), 0.4), 2.0) * lampColor * (1.0 - 0.6 * facing);
body += pale * 0.20 * pow(1.0 - facing, 2.0) * sky;
vec3 seen = behind * pow(pure, vec3(0.55 + 0.5 * thick));
color = mix(body, seen, 0.10 + 0.60 * through);
color += mirror(facing, 0.045) * mix(0.35, 1.0, sky) * roomLight(reflect(-v, n), 0.05) * 0.8;
color += free_ * lamp * lampColor * 0.5 * pow(max(dot(n, normalize(lampTo + v)), 0.0), 90.0);
//// water
vec3 clear = pow(base / max(max(base.r, base.g), max(base.b, 1e-3)), vec3(0.7));
float depth = 0.20 + thick;
vec3 dimmed = pow(clear, vec3(1.3 * (1.0 - exp(-1.1 * depth)))) * exp(-0.55 * depth);
vec3 glow = base * (0.60 * softLight(vec3(upwards)) * (0.3 + 0.7 * sky) + 0.28 * lampColor * lamp);
vec3 inside = behind * dimmed + glow * (1.0 - exp(-1.3 * depth));
float shine = mirror(facing, 0.05);
vec3 mirrored = mix(0.45, 1.0, sky) * roomLight(reflect(-v, n), 0.06) * 1.15;
if (atWall) { shine *= 0.45; }
color = mix(inside, mirrored, shine);
// The film that the eye sees where the surface bends into the glass.
float bent_ = atWall ? smoothstep(0.05, 0.6, 1.0 - dot(normalize(worldNormal), n)) : 0.0;
color += bent_ * 0.35 * softLight(vec3(upwards));
color += free_ * lamp * lampColor * 0.6 * pow(max(dot(n, normalize(lampTo + v)), 0.0), 200.0);
color += free_ * 0.10 * sky * softLight(n) * pow(1.0 - facing, 2.0);
//// syrup
vec3 clear = base / max(max(base.r, base.g), max(base.b, 1e-3));
vec3 dimmed = pow(clear, vec3(0.6 + 5.0 * thick)) * exp(-2.0 * thick);
vec3 rich = pow(base, vec3(mix(0.9, 1.7, 1.0 - exp(-1.5 * thick))));
vec3 body = rich * (lampColor * (0.3 + 0.7 * lamp) * wrapped(dot(n, lampTo), 0.5) + sky * softLight(n));
color = behind * dimmed + body * (1.0 - exp(-5.0 * thick));
color = mix(color, mix(0.4, 1.0, sky) * roomLight(reflect(-v, n), 0.02), mirror(facing, 0.04));
color += lamp * lampColor * 1.6 * pow(max(dot(n, normalize(lampTo + v)), 0.0), 160.0);
//// lava
float heat = clamp(0.45 + 0.55 * facing + 0.25 * carriedRough.x, 0.0, 1.2);
color = base * (0.5 * lampColor * lamp * wrapped(dot(n, lampTo), 0.2) + 0.5 * sky * softLight(n));
color += mix(vec3(0.5, 0.02, 0.0), vec3(1.5, 0.36, 0.03), heat * heat) * heat;
color += mirror(facing, 0.04) * 0.4 * sky * roomLight(reflect(-v, n), 0.3);
//// grain
//VTK::Color::Impl
vec2 off = offsetVCVSOutput.xy;
float far = dot(off, off);
if (far > 1.0) { discard; }
float lit = dot(vec3(off, sqrt(1.0 - far)), LAMP);
float shade = 0.50 + 0.56 * max(0.5 * lit + 0.5, 0.0);
opacity = 1.0;
diffuseColor = vertexColorVSOutput.rgb * shade;
ambientColor = vec3(0.0);
